"""A disk that is full: said before arming, or the run stops safely with the log closed."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hil.log.reader import open_log
from hil.replay import replay_log
from hil.runtime.setup import Overrides
from hil.sim.demo import emulator_process

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB of our own; needs the right to mount."""
    folder = tmp_path / "logs"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("mounting a small file system needs root")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def few_ticks(path: Path) -> bool:
    """Whether the log being written has under a hundred ticks in it yet; all that is before them is 50 kB."""
    return path.stat().st_size < 50_000 or len(open_log(path).ticks) < 100


def command(path: Path, own: tuple[str, ...]) -> list[str]:
    return [sys.executable, "-m", "hil.cli", "run", str(path), *(w for s in own for w in ("--set", s))]


def test_too_small_a_disk_is_said_before_arming(configs: Path, settings: Settings, small_disk: Path) -> None:
    words = command(configs / "demo.toml", settings("loop.duration_s=3600.0"))
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2 and "MB free, this run needs about" in done.stderr
    assert list(small_disk.glob("*.mcap")) == []


def test_a_disk_that_fills_up_stops_the_run_safely(
    configs: Path, settings: Settings, small_disk: Path
) -> None:
    path, own = configs / "demo.toml", settings("loop.duration_s=10.0")
    with emulator_process(path, Overrides(settings=own)):
        process = subprocess.Popen(command(path, own), stdout=subprocess.PIPE, text=True)
        while not (logs := list(small_disk.glob("*.mcap"))) or few_ticks(logs[0]):
            assert process.poll() is None
            time.sleep(0.02)
        subprocess.run(
            ["dd", "if=/dev/zero", f"of={small_disk}/filler", "bs=64k"], capture_output=True, check=False
        )
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 1 and "log failed" in out
    log = open_log(logs[0])
    assert log.damage is None and len(log.ticks) >= 100 and log.ticks["t_ns"][-1] > log.ticks["t_ns"][0]
    assert np.abs(log.ticks["u_q"]).max() <= 300.0
    assert replay_log(log).verdict == "same"
