"""A load that is known beforehand: by the speed squared, by a weight's angle; neutral where none is."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hil.cli import main
from hil.control.cogging import known_load
from hil.control.errors import ControlDesignError
from hil.control.law import LAW_NEUTRAL, new_law_state
from hil.errors import ConfigError
from hil.runtime.setup import Overrides, load_setup
from hil.signals import Reason, TickArray
from hil.sim.simulate import simulate_ticks
from tests.conftest import CONFIGS

K = 8.44e-4
FAN = f'load=[{{kind="fan", k_n_m_s2={K}}}]'
WEIGHT = 'load=[{kind="cogging", torque_n_m=0.9, order=1, phase_rad=-0.3}]'


def known(**keys: float) -> str:
    return "controller.known_load={" + ", ".join(f"{key}={value!r}" for key, value in keys.items()) + "}"


def run(config: str, *settings: str, plant: tuple[str, ...]) -> tuple[TickArray, float]:
    setup = load_setup(CONFIGS / f"{config}.toml", Overrides(settings=settings))
    ticks = simulate_ticks(setup, list(plant))
    assert ticks["reason"][-1] == Reason.STOP_REQUESTED
    return ticks, setup.config.motor.J_kg_m2


def on_ramps(ticks: TickArray, J: float) -> tuple[float, float]:
    """Error of the speed, rms, and the range of the estimate [N m] while the reference moves."""
    at = (np.abs(ticks["dw_ref"]) > 0) & (np.abs(ticks["w"]) > 5.0)
    error = (ticks["w"] - ticks["w_ref"])[at]
    return float(np.sqrt(np.mean(error**2))), float(np.ptp(J * ticks["d_hat_w"][at]))


@pytest.mark.parametrize(
    ("config", "more", "plant", "share"),
    [
        ("demo", (), (), 0.6),
        ("current", (), (), 0.5),
        ("moteus", (), (), 0.8),
        ("demo", ("motor.shaft.resonance_hz=60",), ("coupling={resonance_hz=60, inertia_ratio=1.0}",), 0.6),
    ],
)
def test_a_fan_that_is_known_is_not_waited_for(
    config: str, more: tuple[str, ...], plant: tuple[str, ...], share: float
) -> None:
    plain = on_ramps(*run(config, *more, plant=(FAN, *plant)))
    told = on_ramps(*run(config, *more, known(quadratic_n_m_s2=K), plant=(FAN, *plant)))
    assert plain[1] > 5.0, "without it the estimate holds the whole fan"
    assert told[0] < share * plain[0] and told[1] < 0.3 * plain[1]


def test_a_weight_that_is_known_is_not_waited_for() -> None:
    slow = "reference.w_rad_s=20.0"
    ticks, J = run("cogging", slow, plant=(WEIGHT, "friction={}"))
    told, _ = run(
        "cogging", slow, known(gravity_n_m=0.9, gravity_zero_rad=0.3), plant=(WEIGHT, "friction={}")
    )
    at = slice(3000, 6000)
    errors = [float(np.std((one["w"] - one["w_ref"])[at])) for one in (ticks, told)]
    estimates = [float(np.std(J * one["d_hat_w"][at])) for one in (ticks, told)]
    assert errors[1] < 0.2 * errors[0] and estimates[1] < 0.1 * estimates[0]
    assert np.std((told["T_L_hat"] - told["T_L_true"])[at]) < 0.05, "the whole load is in the log"


def test_what_is_known_is_k_w_w_and_a_sine_of_the_angle() -> None:
    settings = (known(quadratic_n_m_s2=2e-3, gravity_n_m=0.5, gravity_zero_rad=0.3),)
    p, s = (
        load_setup(CONFIGS / "cogging.toml", Overrides(settings=settings)).machine.law[0],
        new_law_state()[0],
    )
    for w, theta in ((0.0, 1.0), (20.0, -2.0), (-30.0, 0.3)):
        s["x"][0], s["theta"] = w, theta
        wanted = 2e-3 * w * abs(w) + 0.5 * math.sin(theta - 0.3)
        assert known_load(p, s, 0.0) == pytest.approx(wanted, abs=1e-12)
    s["theta"] = math.nan
    assert known_load(p, s, 0.0) == pytest.approx(-2e-3 * 900.0), "without an angle the fan is left"


def test_nothing_known_is_neutral_to_the_bit() -> None:
    law = load_setup(CONFIGS / "demo.toml", Overrides()).machine.law[0]
    assert law["cogs"] == 0 and law["k_w2"] == 0.0 == LAW_NEUTRAL["k_w2"]
    plain, _ = run("demo", "loop.duration_s=1.0", plant=())
    zero, _ = run("demo", "loop.duration_s=1.0", known(quadratic_n_m_s2=0.0), plant=())
    assert plain.tobytes() == zero.tobytes()


def test_a_weight_adds_to_a_table_of_cogging() -> None:
    table = "controller.anticogging={n_p=3, k_t_n_m_a=3.6, orders=[%s], cos_n_m=[0.1], sin_n_m=[0.2]}"
    weight = known(gravity_n_m=0.5)
    law = load_setup(CONFIGS / "cogging.toml", Overrides(settings=(table % 36, weight))).machine.law[0]
    assert law["cogs"] == 2 and list(law["cog_order"][:2]) == [1, 36] and list(law["cog_b"][:2]) == [0.5, 0.2]
    with pytest.raises(ControlDesignError, match="has order 1, in which the weight's torque is already"):
        load_setup(CONFIGS / "cogging.toml", Overrides(settings=(table % 1, weight)))


@pytest.mark.parametrize(
    ("config", "settings", "said"),
    [
        ("demo", (known(gravity_n_m=0.5),), "known_load.gravity_n_m: the drive reports no angle; name it in"),
        (
            "demo",
            (known(quadratic_n_m_s2=1.0),),
            "quadratic_n_m_s2: .* N m at limits.w_max_rad_s = .*allow 54",
        ),
        ("cogging", (known(gravity_n_m=60.0),), "gravity_n_m: 60 N m, the limits allow 54 N m"),
        ("demo", (known(quadratic_n_m_s2=-1.0),), "quadratic_n_m_s2: .*greater than or equal to 0"),
        ("demo", (known(quadratic=1.0),), "quadratic: unknown key; did you mean"),
        (
            "salient",
            (
                "controller={kind='torque', torque_n_m=[1.0], for_s=[0.5], "
                "known_load={quadratic_n_m_s2=1e-4}}",
            ),
            "the law torque follows no speed",
        ),
    ],
)
def test_a_known_load_that_can_not_be_is_refused(config: str, settings: tuple[str, ...], said: str) -> None:
    with pytest.raises((ConfigError, ControlDesignError), match=said):
        load_setup(CONFIGS / f"{config}.toml", Overrides(settings=settings))


def test_the_keys_are_explained(capsys: Any) -> None:
    assert main(["config", "explain", "known_load"]) == 0
    said = capsys.readouterr().out
    assert "controller.known_load.quadratic_n_m_s2: number" in said and "(kind ," not in said
