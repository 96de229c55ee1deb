"""hil in Python: public names, light import, each function as its command, and the examples as they stand."""

from __future__ import annotations

import importlib
import inspect
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import hil
from tests.conftest import CONFIGS, ROOT

pytestmark = pytest.mark.slow

DEMO = CONFIGS / "demo.toml"
SHORT = {"loop.duration_s": 1.0}
PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LIGHT = """
import sys, numba.core.config as config
before = {name: repr(value) for name, value in vars(config).items() if name.isupper()}
loaded = set(sys.modules)
import hil
dir(hil)
after = {name: repr(value) for name, value in vars(config).items() if name.isupper()}
assert before == after and len(before) > 50
new = {name.partition(".")[0] for name in set(sys.modules) - loaded}
heavy = {"pydantic", "scipy", "can", "matplotlib", "pandas", "mcap", "drivers", "firmware_model"}
assert not new & heavy, new
"""


def test_the_import_is_light_and_leaves_numba_alone() -> None:
    done = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", hil.__all__)
def test_a_public_name_is_there_said_and_on_the_page(name: str) -> None:
    public = getattr(hil, name)
    what = inspect.unwrap(public)
    assert callable(public) and (what.__doc__ or "").strip() and f"`hil.{name}" in PAGE
    assert name in dir(hil)


def test_the_page_names_nothing_that_is_not_public() -> None:
    named = set(re.findall(r"`hil\.(\w+)[(`]", PAGE))
    assert named == set(hil.__all__)


def test_a_room_of_the_same_name_takes_no_function_away() -> None:
    for name in ("campaign", "replay", "report"):
        module = importlib.import_module(f"hil.{name}")
        assert module.__name__ == f"hil.{name}" and callable(getattr(hil, name)), name
        public = inspect.signature(getattr(hil, name))
        assert "options" not in public.parameters or name == "campaign", public
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = hil.nothing


def test_a_configuration_is_loaded_with_settings_or_refused_with_all_mistakes() -> None:
    assert hil.load(DEMO, {"loop.rate_hz": 500}).config.loop.rate_hz == 500
    assert hil.load(str(DEMO), ["loop.rate_hz=500"]).config == hil.load(DEMO, {"loop.rate_hz": 500}).config
    with pytest.raises(hil.ConfigError) as refused:
        hil.load(DEMO, {"loop.raet_hz": 1, "limits.i_max_a": -1.0})
    assert len(refused.value.problems) == 2
    with pytest.raises(hil.HilError, match="the configuration is loaded"):
        hil.simulate(hil.load(DEMO), SHORT)


def test_a_configuration_built_from_tables_is_that_of_the_file(tmp_path: Path) -> None:
    import tomllib

    tables = tomllib.loads(DEMO.read_text(encoding="utf-8"))
    tables["drive"]["dbc"] = str(CONFIGS / tables["drive"]["dbc"])
    tables["emulator"]["plant"] = str(CONFIGS / tables["emulator"]["plant"])
    made = [hil.build(tables, tmp_path / "mine.toml") for _ in range(2)][1]
    given = hil.load(DEMO, {f"drive.{key}": value for key, value in tables["drive"].items()})
    assert made.config.model_dump(exclude={"emulator"}) == given.config.model_dump(exclude={"emulator"})
    (tmp_path / "kept.toml").write_text("mine")
    with pytest.raises(hil.HilError, match="not made by"):
        hil.build(tables, tmp_path / "kept.toml")
    assert (tmp_path / "kept.toml").read_text() == "mine"


def test_a_simulation_in_memory_is_the_one_in_its_file(tmp_path: Path) -> None:
    setup = hil.load(DEMO, SHORT | {"log.folder": str(tmp_path)})
    memory, file = hil.simulate(setup), hil.simulate(setup, log=True)
    assert not memory.path.exists() and file.path.parent == tmp_path
    assert memory.ticks.tobytes() == file.ticks.tobytes() and memory.result["ended"] == file.result["ended"]
    assert memory.metadata["units"] == file.metadata["units"]
    assert hil.replay(memory).verdict == hil.replay(file).verdict == hil.replay(file.path).verdict == "same"
    mine, theirs = hil.metrics(memory), hil.metrics(file.path)
    known = [name for name, value in mine.items() if value is not None]
    assert len(known) > 5 and [mine[name] for name in known] == pytest.approx(
        [theirs[name] for name in known]
    )
    assert len(hil.plot(memory).axes) > 4
    assert memory.to_pandas()["w"].equals(file.to_pandas()["w"])
    assert hil.simulate(setup, plant={"seed": 5}).ticks["w"].tolist() != memory.ticks["w"].tolist()


def test_a_run_that_ends_by_itself_says_why() -> None:
    log = hil.simulate(DEMO, SHORT | {"limits.w_max_rad_s": 20.0, "reference.w_rad_s": 15.0}, plant={
        "load": [{"kind": "step", "torque_n_m": -30.0, "at_s": 0.5}]})  # fmt: skip
    assert log.result["ended"] == "over_speed" and "limits.w_max_rad_s" in log.result["end"]["text"]


def test_a_bus_that_may_be_real_is_refused_without_arm() -> None:
    with pytest.raises(hil.HilError, match="arm"):
        hil.run(DEMO, {"bus.interface": "socketcan", "bus.channel": "can0"})


def test_a_wish_that_nobody_knows_is_refused() -> None:
    with pytest.raises(hil.HilError, match="there are u_noise_mv"):
        hil.design(DEMO, u_noise=3.0)
    with pytest.raises(hil.HilError, match="there are u_noise_mv"):
        hil.compare(DEMO, ["pi"], noise=3.0)


@pytest.mark.corners
@pytest.mark.parametrize("path", [p for p in EXAMPLES if p.stem != "own_law"], ids=lambda p: p.stem)
def test_an_example_runs(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = [] if path.stem == "log_to_pandas" else [str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [str(path), *folder])
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    said = capsys.readouterr().out
    for picture in tmp_path.glob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    wanted = {
        "simulate_and_plot": r"slower: dip \d.*\npicture: ",
        "sweep_laws": r"(?s)cascade, slow .*PI +J = 0.015.*back in",
        "log_to_pandas": r"(?s)6\d\d\d ticks.*largest load step at 2.5\d\d s: \+5.\d\d N m",
        "lockstep_and_replay": r"replay: same, \d\d\d\d ticks\nreport passed: (True|False)",
    }
    assert re.search(wanted[path.stem], said), said


def test_a_law_of_ones_own_runs_and_replays(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "own_law.py")],
        cwd=tmp_path, capture_output=True, text=True, timeout=250,
    )  # fmt: skip
    assert done.returncode == 0 and done.stdout.count("replay same") == 2, done.stderr


def test_a_law_is_registered_before_the_first_configuration_or_not_at_all() -> None:
    from hil.control.errors import ControlDesignError
    from hil.control.registry import laws, register

    with pytest.raises(ControlDesignError, match="before the first configuration"):
        register(laws()["pi"])


def test_every_example_is_on_the_page() -> None:
    assert len(EXAMPLES) == 5 and all(f"`{path.name}`" in PAGE for path in EXAMPLES)
