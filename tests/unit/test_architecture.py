"""The import rule of the house, read from the source."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGES = ("hil", "drivers", "firmware_model")
STDLIB_OK = {"hashlib", "os", "pathlib", "__future__", "collections", "dataclasses", "math", "typing", "enum"}
STDLIB_OK |= {"cmath", "functools", "importlib", "sys"}
ROOT_MODULES = (
    "runtime/setup",
    "runtime/bus",
    "runtime/header",
    "runtime/refusals",
    "runtime/session",
    "runtime/nodesession",
    "runtime/nodesetup",
)
ROOT_MODULES += ("cli", "runtime/configure", "sim/emulate", "sim/simulate", "sim/demo", "check/checks")
ROOT_MODULES += ("runtime/fused", "runtime/fusednodes")
ROOT_MODULES += ("faults/case", "exchange/rerun", "campaign/case", "replay/frames", "replay/sent")
ROOT_MODULES += ("manual/schema",)
JIT = "drivers.jit"
"""The one jit module of all: knows neither controller nor drive, so that control may re-export it."""
COMPOSITION = {f"hil/{name}.py" for name in ROOT_MODULES}


ROOMS = (
    "control", "log", "tick", "config", "runtime", "replay", "report", "sim", "paper", "tuning", "check",
    "faults", "campaign", "identify", "watch", "exchange", "manual", "bench", "api", "commands",
)  # fmt: skip
"""The rooms of hil, each of which may import from those before it."""
UPWARD = {
    ("hil/config/filtered.py", "hil.tuning.current"),  # asked only for a drive with a filter; loads scipy
    ("hil/config/filtered.py", "hil.tuning.measure"),  # asked only for a shaft that is told; loads scipy
    ("hil/log/writer.py", "hil.replay.snapshot"),  # a process of its own, which follows the ticks
}
LOOSE = {"__init__", "cli", "errors", "ports", "signals"}


def imports(path: Path) -> set[str]:
    """Every module that a file imports, however deep in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def starts(modules: set[str], *heads: str) -> set[str]:
    return {m for m in modules if any(m == h or m.startswith(h + ".") for h in heads)}


def test_there_is_something_to_check() -> None:
    assert all(len(files(package)) > 5 for package in PACKAGES)


@pytest.mark.parametrize("path", files("hil/control"), ids=lambda p: p.name)
def test_control_is_pure(path: Path) -> None:
    foreign = {
        m
        for m in imports(path) - starts(imports(path), "hil.control", "numpy", "scipy", "numba", JIT)
        if m.split(".")[0] not in STDLIB_OK
    }
    assert not foreign


@pytest.mark.parametrize("path", files("drivers"), ids=lambda p: p.name)
def test_drivers_know_neither_side(path: Path) -> None:
    assert not starts(imports(path), "hil", "firmware_model")


@pytest.mark.parametrize("path", files("firmware_model"), ids=lambda p: p.name)
def test_the_emulator_shares_nothing_with_the_controller(path: Path) -> None:
    assert not starts(imports(path), "hil", "drivers.client")


@pytest.mark.parametrize("path", files("hil"), ids=lambda p: str(p.relative_to(ROOT)))
def test_only_the_composition_root_knows_drivers_and_the_emulator(path: Path) -> None:
    if str(path.relative_to(ROOT)) not in COMPOSITION:
        allowed = {JIT} if path == ROOT / "hil/control/jit.py" else set()
        assert not starts(imports(path), "drivers", "firmware_model") - allowed


@pytest.mark.parametrize("name", ["runtime/loop", "tick/supervisor", "tick/guard", "tick/kernel"])
def test_the_loop_knows_ports_signals_and_control_only(name: str) -> None:
    own = starts(imports(ROOT / "hil" / f"{name}.py"), "hil")
    assert own <= starts(
        own,
        "hil.ports",
        "hil.signals",
        "hil.control",
        "hil.tick.guard",
        "hil.tick.supervisor",
        "hil.tick.setpoint",
        "hil.runtime.trouble",
        "hil.runtime.rules",
    )


def test_only_these_modules_are_in_no_room() -> None:
    assert {path.stem for path in (ROOT / "hil").glob("*.py")} == LOOSE
    rooms = {path.parent.name for path in (ROOT / "hil").glob("*/__init__.py")}
    assert rooms == set(ROOMS)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_from_those_before_it(room: str) -> None:
    above = [f"hil.{name}" for name in ROOMS[ROOMS.index(room) + 1 :]]
    for path in files(f"hil/{room}"):
        found = starts(imports(path), *above)
        assert found == {to for name, to in UPWARD if name == str(path.relative_to(ROOT))}, path


def test_nothing_reads_a_clock_but_the_places_that_may() -> None:
    may = {
        "clock",
        "bus",
        "session",
        "nodesession",
        "simulate",
        "ring",
        "recorder",
        "writer",
        "preflight",
        "checks",
    }
    for path in files("hil"):
        figures = {"paper", "bench", "commands", "faults"} & set(path.parts)  # not control
        if path.stem in may or figures:
            continue
        assert "time" not in imports(path), path
