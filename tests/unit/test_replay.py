"""Replay: same inputs, same parameters, same bits; anything else is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hil.errors import HilError
from hil.log.reader import open_log
from hil.replay import Verdict, compare, machine_of, replay, replay_log, replayed
from hil.runtime.setup import Overrides, load_setup
from hil.signals import INPUTS
from hil.sim.simulate import simulate

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    config = Path(__file__).parents[2] / "configs" / "demo.toml"
    settings = (f'log.folder="{folder}"', "loop.duration_s=60.0", "reference.down_at_s=55.0")
    return Path(simulate(load_setup(config, Overrides(settings=settings)), [])["log"])


def test_a_minute_at_1_khz_is_the_same_to_the_bit(logged: Path) -> None:
    verdict = replay(logged)
    assert verdict == Verdict("same", 60_004) and verdict.exit_code == 0


@pytest.mark.parametrize("field", ["w", "i_q", "i_d", "w_ref"])
def test_one_flipped_bit_is_found_where_it_is(logged: Path, field: str) -> None:
    log = open_log(logged)
    ticks = log.ticks.copy()
    row = 31_415 + int(np.nonzero(ticks[field][31_415:])[0][0])  # a bit under a zero is below all outputs
    assert field in INPUTS
    pattern = ticks[field][row : row + 1].copy().view(np.uint64) ^ np.uint64(1 << 30)
    ticks[field][row] = pattern.view(np.float64)[0]
    found = compare(ticks, replayed(machine_of(log), ticks))
    assert found is not None and found.tick == row and found.ulp > 0
    log.ticks = ticks
    verdict = replay_log(log)
    assert verdict.exit_code == 1
    shown = verdict.as_dict()["first_difference"]
    assert set(shown) == {"tick", "field", "logged", "replayed", "ulp"} and shown["tick"] == row


def test_a_flipped_output_is_one_ulp_off(logged: Path) -> None:
    log = open_log(logged)
    ticks = log.ticks.copy()
    ticks["d_hat_w"][777] = np.nextafter(ticks["d_hat_w"][777], np.inf)
    found = compare(ticks, replayed(machine_of(log), ticks))
    assert found is not None and (found.tick, found.field, found.ulp) == (777, "d_hat_w", 1)


def test_missing_records_end_the_comparison(logged: Path) -> None:
    log = open_log(logged)
    log.ticks = np.delete(log.ticks, slice(1000, 1010))
    verdict = replay_log(log)
    assert verdict.verdict == "cannot" and verdict.ticks == 1000 and "10 records are missing" in verdict.why
    log.ticks = log.ticks[5:]
    assert "beginning is missing" in replay_log(log).why


def test_parameters_of_another_machine_are_used_and_of_another_design_refused(logged: Path) -> None:
    log = open_log(logged)
    given = json.loads(log.attachments["controller.json"])
    machine = machine_of(log)
    machine.law["lam_w"] *= 1 + 1e-14  # another processor's last bits
    log.attachments["controller.json"] = machine.to_json()
    assert replay_log(log).verdict == "differs"
    machine.law["lam_w"] *= 1.01
    log.attachments["controller.json"] = machine.to_json()
    with pytest.raises(HilError, match="design of lam_w"):
        machine_of(log)
    log.attachments["controller.json"] = json.dumps(given | {"law": given["law"] | {"newer": 1.0}})
    with pytest.raises(HilError, match=r"newer: not known to this version"):
        machine_of(log)


def test_a_truncated_log_is_replayed_up_to_the_damage(logged: Path, tmp_path: Path) -> None:
    short = tmp_path / "short.mcap"
    raw = logged.read_bytes()
    short.write_bytes(raw[: len(raw) // 2])
    verdict = replay(short)
    assert verdict.verdict == "same" and 10_000 < verdict.ticks < 60_000 and "damaged" in verdict.why


def test_what_is_no_log_cannot_be_replayed(tmp_path: Path) -> None:
    nothing = tmp_path / "x.mcap"
    nothing.write_bytes(b"hello")
    assert replay(nothing).exit_code == 2 and replay(tmp_path / "none.mcap").exit_code == 2
