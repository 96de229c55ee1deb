"""Facts of bus and sensors: from the estimate into the motor's file, and from there into the design."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from hil.config.motor import MotorTable
from hil.config.tables import RunConfig, load_toml
from hil.errors import HilError
from hil.identify.estimate import Estimate
from hil.identify.motorfile import toml_of
from hil.identify.tune import at_motor
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.tuning.bench import bench_of, findings_of, lsb_of, speed_drive
from tests.conftest import CONFIGS

DEMO = CONFIGS / "demo.toml"
FACTS = {
    "w_noise": 0.05, "i_q_noise": 0.004, "i_d_noise": 0.02, "w_lsb": 0.02, "i_q_lsb": 5e-4, "i_d_lsb": 0.01,
    "arrival": 3e-4, "arrival_jitter": 5e-5, "delay": 1.0, "echo_lag": 0.0,
}  # fmt: skip


def identified(folder: Path, **facts: float) -> Path:
    """The file that hil identify writes of a motor with these facts."""
    found, config = Estimate(), load_toml(DEMO, RunConfig)
    for name, value in (FACTS | facts).items():
        found.put(name, value, 0.0)
    file = folder / "motor.toml"
    file.write_text(toml_of(found, config.motor, config, ["a.mcap"]), encoding="utf-8")
    return file


def setup_with(file: Path, *settings: str) -> Setup:
    return load_setup(DEMO, at_motor(Overrides(settings=settings), file))


def test_the_file_has_every_fact_by_its_unit(tmp_path: Path) -> None:
    known = load_toml(identified(tmp_path), MotorTable).identified
    assert known is not None
    assert (known.w_noise_rad_s, known.i_q_noise_a, known.i_d_noise_a) == (0.05, 0.004, 0.02)
    assert (known.w_lsb_rad_s, known.i_q_lsb_a, known.i_d_lsb_a) == (0.02, 5e-4, 0.01)
    assert (known.arrival_ms, known.arrival_jitter_ms) == (0.3, 0.05)
    assert (known.delay_ticks, known.echo_lag_ticks) == (1, 0)


def test_the_design_has_the_noise_that_was_identified(tmp_path: Path) -> None:
    """Resolution included; what is given on the command line goes before, and comes without it."""
    setup = setup_with(identified(tmp_path))
    bench = bench_of(DEMO, setup)
    assert (bench.w_noise, bench.i_noise, bench.i_d_noise) == (0.05, 0.004, 0.02)
    given = bench_of(DEMO, setup, {"w_noise": 0.1, "i_noise": None})
    assert given.w_noise == pytest.approx(math.hypot(0.1, 0.02 / math.sqrt(12))) and given.i_noise == 0.004
    plain = bench_of(DEMO, load_setup(DEMO, Overrides()))
    assert plain.w_noise == pytest.approx(math.hypot(0.01, 0.01 / math.sqrt(12)))


def test_the_coarser_resolution_counts(tmp_path: Path) -> None:
    """Frames of 0.01 rad/s, 1 mA and 0.01 A: a sensor that is coarser than its frame bounds the estimate."""
    setup = setup_with(identified(tmp_path))
    assert lsb_of(setup) == pytest.approx((0.02, 0.001, 0.01))
    quiet = bench_of(DEMO, setup_with(identified(tmp_path, w_noise=1e-5)))
    assert quiet.w_noise == pytest.approx(0.02 / math.sqrt(12))


def test_a_file_with_one_noise_for_both_currents_is_still_read(tmp_path: Path) -> None:
    file = identified(tmp_path)
    lines = [line for line in file.read_text(encoding="utf-8").splitlines() if "_noise_a" not in line]
    lines.insert(lines.index("[identified]") + 1, "i_noise_a = 0.003")
    file.write_text("\n".join(lines), encoding="utf-8")
    bench = bench_of(DEMO, setup_with(file))
    assert bench.i_noise == 0.003 and bench.i_d_noise == 0.003


@pytest.mark.parametrize(
    ("facts", "words"),
    [({"delay": 2.0}, "delays by 2 ticks"), ({"echo_lag": 1.0}, "leave drive.signals.echo out")],
)
def test_a_bus_unlike_the_law_s_is_refused(tmp_path: Path, facts: dict[str, float], words: str) -> None:
    file = identified(tmp_path, **facts)
    with pytest.raises(HilError, match=words):
        speed_drive(DEMO, at_motor(Overrides(), file))


def test_measurements_that_come_too_late_for_the_loop_are_named(tmp_path: Path) -> None:
    """0.3 ms and four times 0.05 ms of jitter: within the demo's 800 us, and not within 400 us."""
    file = identified(tmp_path)
    assert findings_of(setup_with(file)) == []
    (line,) = findings_of(setup_with(file, "loop.feedback_timeout_us=400"))
    assert "up to 0.5 ms" in line and "loop.feedback_timeout_us = 400" in line
    assert findings_of(load_setup(DEMO, Overrides())) == []
