"""What a configuration can't get is said at load, and refused on a bus that may be real."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hil.check.checks import reach_rows
from hil.config.reachable import is_held, voltage_at
from hil.errors import ArmingError
from hil.runtime.refusals import check_reachable
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup

pytestmark = pytest.mark.slow

CASES = (
    ("reference.w_rad_s=151.0", "limits.w_max_rad_s = 150 stops it"),
    ("reference.w_rad_s=-151.0", "limits.w_max_rad_s = 150 stops it"),
    ('reference={kind="sine", offset_rad_s=100.0, amplitude_rad_s=60.0, frequency_hz=1.0}', "reaches 160"),
    ('reference={kind="table", t_s=[0.0, 1.0], w_rad_s=[0.0, -200.0]}', "reaches 200"),
    ("reference.w_rad_s=130.0", "takes 312"),
    ("limits.v_dc_max_v=500.0", "gives 288.7 V"),
    ("controller.current_pole_rad_s=4000.0", "controller.current_pole_rad_s = 4000"),
    ("observer.speed.gamma_2_rad_s=4000.0", "observer.speed.gamma_2_rad_s = 4000"),
    ("observer.speed.delay_ms=12.3", "observer.speed.delay_ms = 12.3: no whole number of periods"),
)


@pytest.mark.parametrize("name", ["demo", "inverter", "paper", "can0", "vcan0", "salient"])
def test_the_shipped_configurations_ask_for_nothing_out_of_reach(configs: Path, name: str) -> None:
    assert load_setup(configs / f"{name}.toml", Overrides()).warnings == ()


@pytest.mark.parametrize(("setting", "said"), CASES)
def test_what_is_out_of_reach_is_said(
    configs: Path, setting: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    setup = load_setup(configs / "demo.toml", Overrides(settings=(setting,)))
    assert any(said in line for line in setup.warnings)
    check_reachable(setup)
    assert said in capsys.readouterr().err
    assert [row.verdict for row in reach_rows(setup)] == ["warn"] * len(setup.warnings)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            ("reference.w_rad_s=140.0", "limits.i_max_a=9.0"),
            "140 rad/s can't be held with 180 V even by a weakened",
        ),
        (("reference.w_rad_s=-140.0", "limits.i_max_a=9.0"), "field of 9 A .* take a lower speed$"),
        (
            ("reference.w_rad_s=120.0", "limits.v_dc_max_v=490.0"),
            "at 120 rad/s the magnets give 498.8 V .* = 490 ",
        ),
        (('controller={kind="cascade"}',), "reference: 120 rad/s takes 288 V without load, there are 180 V"),
    ],
)
def test_past_base_speed_what_no_weakened_field_holds_is_said(
    configs: Path, settings: tuple[str, ...], said: str
) -> None:
    setup = load_setup(configs / "salient.toml", Overrides(settings=settings))
    (line,) = setup.warnings
    assert re.search(said, line)


def test_the_speed_that_a_weakened_field_holds_ends_where_the_current_does(configs: Path) -> None:
    """Without load and R_s: n_p w (psi_f - L_d i_max) = share u_max."""
    config = load_setup(configs / "salient.toml", Overrides(settings=("motor.R_s_ohm=1e-6",))).config
    most = 0.92 * 180.0 / (3 * (0.8 - 0.033 * 15.0))
    assert is_held(config, 0.999 * most, 180.0) and not is_held(config, 1.001 * most, 180.0)


def test_on_a_bus_that_may_be_real_it_is_refused(configs: Path) -> None:
    setup = load_setup(configs / "can0.toml", Overrides(settings=("reference.w_rad_s=41.0",)))
    with pytest.raises(ArmingError, match=r"limits\.w_max_rad_s = 40 stops it; take less; nothing was sent"):
        run(setup, arm=True)
    assert {row.verdict for row in reach_rows(setup)} == {"fail"}


def test_the_voltage_of_a_speed(configs: Path) -> None:
    config = load_setup(configs / "demo.toml", Overrides()).config
    assert voltage_at(config, 100.0) == pytest.approx(3 * 0.8 * 100.0, rel=1e-3)


def test_simulate_says_it_too(configs: Path) -> None:
    command = [sys.executable, "-m", "hil.cli", "simulate", str(configs / "demo.toml"), "--duration", "0.1"]
    done = subprocess.run(
        [*command, "--no-log", "--json", "--set", "observer.speed.delay_ms=12.3"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "delay_ms = 12.3" in done.stderr and json.loads(done.stdout)["ok"]
