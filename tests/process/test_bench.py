"""`hil bench` on real processes: a quick one from the command line, and what it refuses."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.process, pytest.mark.alone]


def bench(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hil.cli", "bench", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)


@pytest.mark.long
@pytest.mark.compiled
def test_a_quick_bench_measures_everything(tmp_path: Path, channel: str) -> None:
    earlier = tmp_path / "earlier.json"
    earlier.write_text(json.dumps({"tick_us": {"control": 1e6}}))
    words = ["--quick", "--json", "-c", channel, "--compare", str(earlier), "-o", str(tmp_path)]
    done = bench(*words, "--set", "realtime.lock_memory=false")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert set(result["wall_us"]) == {"exchange", "control", "send", "record"}
    assert all(value > 0 for value in result["wall_us"].values())
    named = {"sync, receive, check, decode", "control", "guard", "encode, send", "record"}
    assert named < set(result["tick_us"])
    # what the meter takes is taken off, so the sum is near the plain run's, on a machine with others on it
    assert 0.3 < sum(result["tick_us"].values()) / result["processor_us"] < 3.0
    assert 0 <= result["without_fifo"]["in_time"] <= 1
    assert result["record_us"] == result["tick_us"]["record"]
    assert result["ticks"] >= 1000 and result["dropped"] == 0
    assert result["lateness_us"]["samples"] == result["ticks"]
    assert result["processor_us"] > 0 and result["bare_processor_us"] > 0
    assert result["replay_x_realtime"] > 0 and result["simulate_x_realtime"] > 0
    assert result["rate_hz"] in (0, 1000) and result["start_s"] > 0
    assert (result["cyclictest_us"] is None) == ("apt install" in result["cyclictest"])
    assert 0 < result["compared"]["tick_us.control"]["ratio"] < 1
    assert (tmp_path / "lateness.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "bench.html").read_text()
    assert "data:image/png;base64," in page and "://" not in page  # no part of a picture: base64 has no colon


def test_a_bus_that_may_have_a_real_drive_is_refused() -> None:
    done = bench("--quick", "configs/can0.toml")
    assert done.returncode == 2
    assert "can0: a bench runs the emulated drive" in done.stderr


@pytest.mark.long
def test_a_file_to_compare_with_is_read_before_anything_is_measured(tmp_path: Path) -> None:
    done = bench("--quick", "--compare", str(tmp_path / "none.json"))
    assert done.returncode == 2
    assert "none.json: is no output of hil bench --json" in done.stderr
