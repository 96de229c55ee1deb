"""Every registered law and observer by config: designs, runs in the tick, replays to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.design import law_spec
from hil.config.tables import RunConfig, load_toml
from hil.control.errors import ControlDesignError
from hil.control.law import LAW_PARAMS, PI, command, design_law, new_law_state, observe
from hil.control.laws.lq import lq_gain
from hil.control.registry import laws, observers
from hil.errors import ConfigError
from hil.replay import replay
from hil.report.metrics import operating
from hil.runtime.setup import Overrides, load_setup
from hil.signals import Reason
from hil.sim.simulate import simulate, simulate_ticks
from tests.conftest import CONFIGS

DEMO = CONFIGS / "demo.toml"
D = "delay_ms=10.0"
OBSERVERS = {
    "ftdob": 'kind="ftdob", gamma_1_rad_s=30.0, gamma_2_rad_s=70.0, delay_ms=10.0',
    "dob": 'kind="dob", gamma_1_rad_s=60.0',
    "least-noise": f'kind="least-noise", {D}',
    "cubic": f'kind="cubic", {D}',
    "ramp-exact": 'kind="ramp-exact", delay_ms=60.0',
    "harmonic-exact": 'kind="harmonic-exact", delay_ms=60.0, frequency_hz=5.0',
    "exponentials": f'kind="exponentials", gammas_rad_s=[50.0, 100.0, 150.0], {D}',
    "eso": 'kind="eso", bandwidth_rad_s=100.0',
    "adaptive": 'kind="adaptive", delay_ms=40.0, short_ms=12.0, first_ms=2.0, '
    "w_noise_rad_s=0.0104, i_noise_a=0.0036",
    "kalman": 'kind="kalman", d_walk_per_s=20000.0, x_noise=0.01, filtered_state=true',
}
LAWS = {
    "cascade": 'kind="cascade"',
    "pi": 'kind="pi", speed_gain_as_rad=0.39, speed_integral_a_rad=15.0, current_gain_v_a=6.5, '
    "current_integral_v_as=674.0",
    "lq": 'kind="lq", speed_weight=100.0',
    "deadbeat": 'kind="deadbeat"',
    "speed": 'kind="speed"',
    "position": 'kind="position"',
    "mtpa": 'kind="mtpa"',
}


def config_of(law: str) -> Path:
    """A configuration whose drive takes what the law asks for."""
    if law == "position":  # it needs an angle
        return CONFIGS / "position.toml"
    return DEMO if "voltage" in laws()[law].takes else CONFIGS / "current.toml"


def settings(law: str = "cascade", observer: str = "ftdob") -> tuple[str, ...]:
    one = "{" + OBSERVERS[observer] + "}"
    return (f"controller={{{LAWS[law]}}}", f"observer.speed={one}", f"observer.current={one}")


def test_a_broken_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = tmp_path / "house_laws-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: house-laws\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text("[hil.laws]\nbroken = house_laws:MEMBER\n")
    (tmp_path / "house_laws.py").write_text('raise RuntimeError("no licence")\n')
    monkeypatch.syspath_prepend(tmp_path)
    laws.cache_clear()
    said = "hil.laws: broken = house_laws:MEMBER: RuntimeError: no licence"
    try:
        with pytest.raises(ControlDesignError, match=f"^{said}$"):
            laws()
    finally:
        laws.cache_clear()


def params(*more: str) -> Any:
    return design_law(law_spec(load_toml(DEMO, RunConfig, more)), 1e-3)[0]


def test_every_member_is_tried_here() -> None:
    assert set(OBSERVERS) == set(observers())
    # identify: tests/unit/test_identify*; torque, follow close no loop: tests/unit/test_nodes.py
    assert set(LAWS) | {"fac", "follow", "identify", "torque"} == set(laws())


@pytest.mark.parametrize(
    ("law", "observer"), [(law, "ftdob") for law in LAWS] + [("cascade", o) for o in OBSERVERS]
)
@pytest.mark.compiled  # a whole run: interpreted it takes minutes
def test_runs_in_simulate_and_replays_to_the_bit(tmp_path: Path, law: str, observer: str) -> None:
    setup = load_setup(
        config_of(law), Overrides(settings=(*settings(law, observer), f'log.folder="{tmp_path}"'))
    )
    result = simulate(setup, [])
    assert result["ended"] == "stop_requested"
    assert replay(Path(result["log"])).verdict == "same"


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.compiled  # a whole run: interpreted it takes minutes
def test_every_law_holds_the_load(law: str) -> None:
    ticks = simulate_ticks(load_setup(config_of(law), Overrides(settings=settings(law))))
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    own = operating(ticks)
    error, t = np.abs(own["w"] - own["w_ref"]), own["t_ns"] * 1e-9
    assert 1.0 < error.max() < 9.0
    assert error[(t > 3.2) & (t < 4.4)].max() < 0.3


def test_what_todays_configs_say_means_the_same() -> None:
    p = params()
    assert not p["shaped"] and not p["form"].any() and not p["g"].any() and not p["k_p"].any()
    for name in LAW_PARAMS.names[LAW_PARAMS.names.index("shaped") :]:
        assert not np.any(p[name]), f"{name}: its neutral value is zero"


def test_a_pi_that_is_held_at_its_limits_does_not_wind_up() -> None:
    p, s = params(*settings("pi")), new_law_state()[0]
    assert p["kind"] == PI
    observe(p, s, 0.0, 0.0, 0.0, True, 1)
    for _ in range(5000):  # speed and currents do not follow at all
        observe(p, s, 0.0, 0.0, 0.0, True, 1)
        command(p, s, 80.0, 0.0, 0.0, 100.0)
    assert s["i_q_ref"] == p["i_max"] and s["u"][1] == 100.0
    assert abs(s["I"][0]) <= p["i_max"] * (1 + 1e-9) and abs(s["I"][1]) <= 100.0 * (1 + 1e-9)
    observe(p, s, 90.0, 15.0, 0.0, True, 1)  # overshoot: the current turns at once
    command(p, s, 80.0, 0.0, 0.0, 300.0)
    assert s["i_q_ref"] < p["i_max"] - 3.0


def test_lq_places_exactly_its_gain() -> None:
    p = params(*settings("lq"))
    K = lq_gain(p["Ad"][:2, :2], p["Bd"][:2, 1:2], np.array([100.0, 1e-3]))[0]
    for x in ((1.0, 0.0), (0.0, 1.0)):
        s = new_law_state()[0]
        observe(p, s, x[0], x[1], 0.0, True, 1)
        command(p, s, 0.0, 0.0, 0.0, 1e9)
        assert s["u"][1] == pytest.approx(-float(K @ s["x_p"][:2]), rel=1e-9)


def test_deadbeat_ends_the_current_error_after_the_delay() -> None:
    p, s = params(*settings("deadbeat"), "controller.compensate_coupling=false"), new_law_state()[0]
    observe(p, s, 0.0, 3.0, 1.0, True, 1)
    command(p, s, 0.0, 0.0, 0.0, 1e9)
    two = p["Ad"] @ s["x_p"] + p["Bd"] @ s["u"]
    np.testing.assert_allclose(two[1:], [s["i_q_ref"], 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ('observer.speed={kind="least-noise", delay_ms=300.0}', "takes 1 to 256"),
        ('observer.speed={kind="ramp-exact", delay_ms=1.0}', "takes 2 to 256"),
        ('observer.speed={kind="harmonic-exact", delay_ms=9.0, frequency_hz=700.0}', "above half the loop"),
        ('observer.speed={kind="exponentials", gammas_rad_s=[5.0, 5.0], delay_ms=9.0}', "too close together"),
        (f"observer.speed={{{OBSERVERS['kalman']}}}", "give it to both"),
    ],
)
def test_designs_that_can_not_be_are_refused(override: str, said: str) -> None:
    with pytest.raises(ControlDesignError, match=said):
        params(override)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ('controller={kind="lqg"}', "controller: kind must be one of .*'cascade'"),
        ('observer.speed={kind="cubic"}', r"observer\.speed\.delay_ms: missing"),
        (
            'observer.speed={kind="cubic", delay_m=3.0}',
            r"observer\.speed\.delay_m: unknown key; did you mean 'delay_ms'",
        ),
        (
            'observer.current={kind="eso", bandwidth_rad_s=5.0, damping=0.1}',
            r"observer\.current\.damping: .*0\.3",
        ),
        (
            'observer.speed={kind="exponentials", delay_ms=9.0, gammas_rad_s=[1.0, 2.0, 3.0, 4.0]}',
            "at most 3",
        ),
        ("controller.speed_pole_rad=3.0", r"controller\.speed_pole_rad: unknown key; did you mean"),
    ],
)
def test_tables_that_can_not_be_are_refused(override: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_toml(DEMO, RunConfig, [override])
