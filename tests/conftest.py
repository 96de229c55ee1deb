"""Shared fixtures: shipped configurations, unique bus channels, logs in a temporary folder."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # small matrices; before numpy
    os.environ.setdefault(name, "1")
ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ROOT / "configs"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in the background of a script: programs inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

if worker := os.environ.get("PYTEST_XDIST_WORKER"):  # no list of runs is another worker's
    os.environ["XDG_RUNTIME_DIR"] = tempfile.mkdtemp(prefix=f"hil-{worker}-")


FIGURE = "figure"
"""Property of a test: a line that is shown at the end."""
MACHINE = "tests/vm/"
"""Its tests share one boot of the bench machine: one worker's, and the longest job of all."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Which cases are long; the longest job first, so that other workers have something to do meanwhile."""
    items.sort(key=lambda item: not item.nodeid.startswith(MACHINE))
    for item in items:
        if item.get_closest_marker("corners") and any(item.callspec.indices.values()):
            item.add_marker("long")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadScopeScheduling | None:
    """A file is on one worker (``--dist=loadfile``), and the bench machine's files are on one."""
    if config.getoption("dist") != "loadfile":
        return None

    class Files(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return MACHINE if nodeid.startswith(MACHINE) else nodeid.split("::", 1)[0]

    return Files(config, log)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Show the figures of the runs on SocketCAN, whichever process ran them."""
    reports = [*terminalreporter.getreports("passed"), *terminalreporter.getreports("failed")]
    lines = [line for one in reports for name, line in one.user_properties if name == FIGURE]
    if lines:
        terminalreporter.section("SocketCAN")
        terminalreporter.write_line("\n".join(lines))


def pytest_unconfigure() -> None:
    """A worker's own folder goes with it."""
    if worker:
        shutil.rmtree(os.environ["XDG_RUNTIME_DIR"], ignore_errors=True)


@pytest.fixture
def configs(tmp_path: Path) -> Path:
    """The shipped configurations, the demo's drive patient with a busy host."""
    copy = tmp_path / "configs"
    shutil.copytree(CONFIGS, copy)
    with (copy / "plants" / "demo.toml").open("a", encoding="utf-8") as plant:
        plant.write("\n[firmware]\nwatchdog_ms = 400.0\n")
    return copy


@pytest.fixture
def channel() -> str:
    """A bus of its own for each test."""
    return f"test-{uuid.uuid4().hex[:12]}"


@pytest.fixture
def settings(channel: str, tmp_path: Path) -> Callable[..., tuple[str, ...]]:
    """Overrides that keep a test to itself: own channel, own log folder, no real-time rights needed."""

    def make(*more: str) -> tuple[str, ...]:
        return (
            f'bus.channel="{channel}"',
            f'log.folder="{tmp_path / "logs"}"',
            "realtime.lock_memory=false",
            "feedback.hold_ticks=150",
            "feedback.quick_stop_ticks=200",
            "loop.max_gap_ticks=64",
            *more,
        )

    return make
