"""A short run of every fuzzing target with fixed seeds, and the proof that the targets can fail."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.fuzz.inputs import Target, fuzz, targets

MOST = {
    "config": 60,
    "plant": 60,
    "faults": 30,
    "dbc": 20,
    "log": 20,
    "rec-log": 60,
    "rec-asc": 60,
    "rec-trc": 60,
    "rec-blf": 60,
    "rec-mf4": 20,
    "codec": 500,
    "client": 60,
    "guard": 300,
}
TICKS = 300


@pytest.fixture(scope="module")
def every(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return targets(tmp_path_factory.mktemp("fuzz"))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy scalars warn where compiled code does not
@pytest.mark.parametrize("name", [*MOST, "tick"])
def test_seeded_inputs_are_taken_or_refused(every: dict[str, Target], name: str) -> None:
    most = MOST.get(name, TICKS)
    assert fuzz(name, every[name], seed=1, seconds=120.0, most=most) > 0


@pytest.mark.long
def test_deliberate_breaks_of_guard_and_client_are_noticed() -> None:
    command = [sys.executable, "-m", "tests.fuzz.breaks"]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" input ") > 20


@pytest.mark.long
@pytest.mark.compiled
@pytest.mark.parametrize(
    "more", [["--inputs", "100"], ["--inputs", "60", "--unchecked"]], ids=["as is", "unchecked"]
)
def test_no_logged_number_leads_a_kernel_out_of_its_arrays(more: list[str]) -> None:
    """With the reader's ranges left out the bounds checks find it: so they are on, and find what there is."""
    command = [sys.executable, "-m", "tests.fuzz.bounds", *more]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert ("out of bounds" in done.stdout) == ("--unchecked" in more)


def test_a_failure_names_its_input(tmp_path: Path) -> None:
    def take(data: bytes) -> None:
        raise ZeroDivisionError(len(data))

    with pytest.raises(AssertionError, match="input broken/7/0: ZeroDivisionError"):
        fuzz("broken", Target(take), seed=7, seconds=10.0, most=3)
