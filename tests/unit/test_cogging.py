"""The known load over the shaft's angle: its closed form, its file, and how it is learned from estimates."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.design import build, known_cogging
from hil.config.tables import RunConfig, load_toml
from hil.control.cogging import MOST_ANGLE, ORDERS, Harmonics, ahead, cog_params, torque_at, unit
from hil.control.errors import ControlDesignError
from hil.control.law import LAW_NEUTRAL, LAW_PARAMS, LAW_STATE
from hil.errors import ConfigError, HilError
from hil.identify.cogging import MOST, filtered, learned, response, rows_of
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, RxFlag, new_ticks
from tests.conftest import CONFIGS

pytestmark = pytest.mark.slow

PATH = CONFIGS / "cogging.toml"
FILE = {
    "motor": "reconstruction", "n_p": 3, "k_t_n_m_a": 3.6, "orders": [1, 36],
    "cos_n_m": [0.1, 0.2], "sin_n_m": [0.0, -0.3],
}  # fmt: skip


def record(known: Harmonics | None) -> Any:
    p = np.zeros(1, LAW_PARAMS)
    for name, value in cog_params(known, 0.002, 0.7, 1e-3).items():
        p[name] = value
    return p[0]


def table(**changes: Any) -> str:
    rows = ", ".join(f"{key} = {json.dumps(value)}" for key, value in (FILE | changes).items())
    return f"controller.anticogging={{ {rows} }}"


def test_cosine_and_sine_are_those_of_the_library_to_the_rounding_of_the_angle() -> None:
    for theta in (*np.linspace(-20.0, 20.0, 4001), 0.0, 1e-9, 1e6, -123456.789):
        c, s = unit(float(theta))
        off = 4e-16 * (1.0 + abs(theta))
        assert abs(c - math.cos(theta)) < off and abs(s - math.sin(theta)) < off, theta


def test_the_torque_is_the_sum_of_its_harmonics_and_nothing_without_an_angle() -> None:
    rng = np.random.default_rng(7)
    orders = tuple(sorted(int(n) for n in rng.choice(np.arange(1, 400), ORDERS, replace=False)))
    known = Harmonics(orders, tuple(rng.normal(size=ORDERS)), tuple(rng.normal(size=ORDERS)))
    p = record(known)
    for theta in rng.uniform(-30.0, 30.0, 200):
        angles = np.array(orders) * theta
        wanted = float(np.dot(known.a, np.cos(angles)) + np.dot(known.b, np.sin(angles)))
        assert torque_at(p, theta, 0.5) == pytest.approx(wanted, abs=1e-11)
        assert float(known.torque(np.array([theta]))[0]) == pytest.approx(wanted, abs=1e-11)
    for theta in (math.nan, math.inf, -math.inf, MOST_ANGLE, -2.0 * MOST_ANGLE):
        assert torque_at(p, theta, 0.0) == 0.0
    assert torque_at(record(None), 1.0, 0.0) == 0.0
    assert Harmonics((2,), (3.0,), (4.0,)).peak == pytest.approx(5.0, rel=1e-3)


def test_a_harmonic_fades_where_the_period_is_too_long_for_it() -> None:
    p = record(Harmonics((1, 40), (1.0, 2.0), (0.0, 0.0)))
    for w, wanted in (
        (9.9, 3.0),
        (-10.0, 3.0),
        (15.0, 2.0),
        (-17.5, 1.5),
        (20.0, 1.0),
        (300.0, 1.0),
        (900.0, 0.0),
    ):
        assert torque_at(p, 0.0, w) == pytest.approx(wanted), w


def test_what_is_asked_for_gives_the_right_current_behind_a_lag() -> None:
    known, s = Harmonics((36,), (0.2,), (0.3,)), np.zeros(1, LAW_STATE)[0]
    p = record(known)
    p["J"], p["T_s"], lam, i, off = 0.011, 1e-3, 0.7, 0.0, []
    s["x"][0] = 3.0
    for k in range(400):
        s["theta"] = 3e-3 * k
        i = lam * i + (1.0 - lam) * ahead(p, s)
        off.append(i + float(known.torque(np.array([3e-3 * (k + 2)]))[0]) / 0.011)
    assert max(map(abs, off[100:])) < 1e-9


def test_without_a_file_every_parameter_is_neutral() -> None:
    law = load_setup(PATH, Overrides()).machine.law[0]
    names = [name for name in LAW_PARAMS.names or () if name.startswith("cog")]
    assert names == ["cogs", "cog_order", "cog_a", "cog_b", "cog_lead", "cog_lag", "cog_slow"]
    assert all(LAW_NEUTRAL[name] == 0.0 and not np.any(law[name]) for name in names)


def test_a_file_is_named_in_the_configuration(tmp_path: Path) -> None:
    rows = "\n".join(f"{key} = {json.dumps(value)}" for key, value in FILE.items())
    (tmp_path / "own.toml").write_text(rows)
    given = Overrides(settings=(f"controller.anticogging={json.dumps(str(tmp_path / 'own.toml'))}",))
    law = load_setup(PATH, given).machine.law[0]
    assert (
        law["cogs"] == 2 and list(law["cog_order"][:2]) == [1, 36] and list(law["cog_b"][:2]) == [0.0, -0.3]
    )
    assert law["cog_lead"] == 2e-3 and law["cog_lag"] == law["lam_q"] and law["cog_slow"] == 400.0


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        (
            table(motor="another"),
            "learned of a motor 'another'.*the configuration's is 'reconstruction'.*learn it",
        ),
        (table(n_p=4), "n_p = 4"),
        (table(k_t_n_m_a=4.1), "k_t = 4.1"),
        (table(cos_n_m=[0.1, 55.0]), "its peak is .* N m, the limits allow 54 N m"),
        (table(cos_n_m=[0.1]), "must be of one length"),
        (table(error_n_m=[0.1]), "must be of one length"),
        (table(orders=[36, 1]), "orders must ascend"),
        (table(orders=[], cos_n_m=[], sin_n_m=[]), "orders: missing; learn it anew"),
        ("controller.anticogging={ n_p = 3, k_t_n_m_a = 3.6 }", "orders: missing; learn it anew"),
        (table(orders=[0, 1]), "orders.0: .*greater than or equal to 1"),
        (table(orders=[1, 2000]), "orders.1"),
        (table(order=[1]), "order: unknown key; did you mean 'orders'"),
        (table().replace("0.2", "nan"), "cos_n_m.1: .*finite"),
        (table().replace("0.2", "inf"), "cos_n_m.1: .*finite"),
        (table(**{"orders": list(range(1, 26)), "cos_n_m": [0.0] * 25, "sin_n_m": [0.0] * 25}), "orders.*24"),
        ('controller.anticogging="nowhere.toml"', "controller.anticogging: .*nowhere.toml: can't be read"),
    ],
)
def test_a_file_that_can_not_be_is_refused_in_one_line(setting: str, said: str) -> None:
    with pytest.raises((ConfigError, ControlDesignError), match=said) as refused:
        load_setup(PATH, Overrides(settings=(setting,)))
    assert "controller.anticogging" in str(refused.value) and len(str(refused.value).splitlines()) <= 2


def test_a_drive_without_an_angle_can_not_have_it() -> None:
    with pytest.raises(
        ControlDesignError, match=r"the drive reports no angle; name it in drive\.signals\.angle"
    ):
        load_setup(CONFIGS / "demo.toml", Overrides(settings=(table(),)))


def test_a_motor_without_a_name_is_judged_by_its_numbers() -> None:
    config = load_toml(PATH, RunConfig, [table(motor="")])
    known = known_cogging(config)
    assert known is not None and known.orders == (1, 36)
    assert build(config, load_setup(PATH, Overrides()).wire).law["cogs"][0] == 2


def estimates(
    orders: dict[int, tuple[float, float]], law: Any, g: Any, T_s: float, noise: float = 0.0
) -> Any:
    """Ticks of an observer whose window is g, over laps at a speed that is not constant, forward and back."""
    seconds = 11.0
    t = np.arange(round(2 * seconds / T_s)) * T_s
    forward = t < seconds
    w = np.where(forward, 2.2, -2.2) + 0.3 * np.sin(9.0 * t)
    theta = np.cumsum(w) * T_s
    T = np.where(forward, 0.3, -0.2)
    for n, (a, b) in orders.items():
        ends = a * np.cos(n * theta) + b * np.sin(n * theta)
        T = T + np.r_[ends[0], 0.5 * (ends[1:] + ends[:-1])]
    ticks = new_ticks(len(t))
    ticks["t_ns"], ticks["gap"], ticks["w"] = np.rint(t * 1e9), 1, w
    ticks["theta"] = np.mod(theta, 2.0 * math.pi)
    ticks["w_ref"] = np.where(forward, 2.2, -2.2)
    ticks["rx_flags"] = int(RxFlag.FRESH)
    ticks["state"] = ticks["drive_state"] = int(DriveState.OPERATION_ENABLED)
    T = filtered(g, T[:, None])[:, 0]
    ticks["d_hat_w"] = -(T + np.random.default_rng(3).normal(0.0, noise, len(t))) / float(law["J"])
    return ticks


ADAPTIVE = '{kind="adaptive", delay_ms=20.0, short_ms=8.0, w_noise_rad_s=0.01, i_noise_a=0.002}'
TRUE = {1: (0.05, -0.02), 36: (0.2, 0.3), 72: (0.0, 0.1)}


def test_lag_and_acceleration_of_the_window_are_taken_off_exactly() -> None:
    config = load_toml(PATH, RunConfig)
    law, g = load_setup(PATH, Overrides()).machine.law[0], response(config)
    assert g.sum() == pytest.approx(1.0) and len(g) >= 22
    found = learned([rows_of(estimates(TRUE, law, g, 1e-3), law, g, 1e-3)])
    assert found.known.orders == tuple(TRUE)
    for (a, b), x, y in zip(TRUE.values(), found.known.a, found.known.b, strict=True):
        assert (x, y) == pytest.approx((a, b), abs=1e-9)
    assert found.residual < 1e-9 and found.friction == pytest.approx(0.25)
    assert (
        0.2 < found.before < math.sqrt(sum(a * a + b * b for a, b in TRUE.values()) / 2)
    )  # by the window less


def test_intervals_hold_the_truth_and_noise_alone_is_no_harmonic() -> None:
    config = load_toml(PATH, RunConfig)
    law, g = load_setup(PATH, Overrides()).machine.law[0], response(config)
    found = learned([rows_of(estimates(TRUE, law, g, 1e-3, 0.2), law, g, 1e-3)])
    assert found.known.orders == tuple(TRUE)
    for (a, b), x, y, half in zip(TRUE.values(), found.known.a, found.known.b, found.half, strict=True):
        assert abs(x - a) < 1.5 * half and abs(y - b) < 1.5 * half and half < 0.03
    assert learned([rows_of(estimates({}, law, g, 1e-3, 0.2), law, g, 1e-3)]).known.orders == ()


def test_what_a_table_knew_already_is_learned_with_it() -> None:
    own = tuple(f"{text}" for text in (table(cos_n_m=[0.05, 0.1], sin_n_m=[-0.02, 0.1]),))
    config, law = load_toml(PATH, RunConfig, own), load_setup(PATH, Overrides(settings=own)).machine.law[0]
    g = response(config)
    left = {36: (0.1, 0.2), 72: (0.0, 0.1)}
    found = learned([rows_of(estimates(left, law, g, 1e-3), law, g, 1e-3)])
    assert found.known.orders == tuple(TRUE)
    assert found.known.a == pytest.approx([a for a, _ in TRUE.values()], abs=1e-9)
    assert found.known.b == pytest.approx([b for _, b in TRUE.values()], abs=1e-9)


def test_too_few_laps_and_a_window_without_a_length_are_refused() -> None:
    config = load_toml(PATH, RunConfig)
    law, g = load_setup(PATH, Overrides()).machine.law[0], response(config)
    ticks = estimates(TRUE, law, g, 1e-3)
    with pytest.raises(HilError, match="whole laps at a steady speed"):
        learned([rows_of(ticks[:4000], law, g, 1e-3)])
    ticks["theta"] = math.nan
    with pytest.raises(HilError, match="0 whole laps"):
        learned([rows_of(ticks, law, g, 1e-3)])
    own = load_toml(PATH, RunConfig, [f"observer.speed={ADAPTIVE}"])
    with pytest.raises(HilError, match="adaptive: its window has no fixed length"):
        response(own)
    assert MOST > 72


def test_a_drive_that_measures_in_some_ticks_alone_is_refused() -> None:
    own = ("feedback.period_ms=5.0", table(k_t_n_m_a=3.6))
    config = load_toml(CONFIGS / "odrive.toml", RunConfig, own)
    with pytest.raises(ControlDesignError, match=r"anticogging: needs the angle in each tick; .*period_ms"):
        known_cogging(config)
    with pytest.raises(HilError, match=r"feedback\.period_ms: cogging is learned from an angle in each tick"):
        response(load_toml(CONFIGS / "odrive.toml", RunConfig, own[:1]))
