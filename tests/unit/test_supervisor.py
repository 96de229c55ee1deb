"""The supervisor as a pure transition function: every way into a stop, and no way back."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from hil.config.design import Machine, WireFacts, build
from hil.config.tables import RunConfig, load_toml
from hil.signals import Controlword, DriveState, Reason, Request, RxFlag, new_ticks
from tests.conftest import CONFIGS

WIRE = WireFacts(0.01, 0.01, 16, (0.01, 0.001, 0.01), 327.67)
FRESH = int(RxFlag.FRESH)


@dataclass
class Bench:
    """A controller whose inputs the test sets by hand; the drive obeys its controlwords one tick late."""

    machine: Machine
    ticks: Any = field(default_factory=new_ticks)
    drive: int = int(DriveState.SWITCH_ON_DISABLED)
    obedient: bool = True

    @property
    def t(self) -> Any:
        return self.ticks[0]

    def step(self, flags: int = FRESH, gap: int = 1, **inputs: float) -> Any:
        t = self.t
        t["gap"], t["rx_flags"], t["drive_state"], t["echo"] = gap, flags, self.drive, t["counter"]
        t["v_dc"], t["temperature_motor"], t["temperature_inverter"] = 540.0, 25.0, 25.0
        t["w"] = t["i_q"] = 0.0
        t["i_d"] = 0.01 * (int(t["k"]) % 2)  # a reading that stands still would be a fault
        t["request"] = int(Request.ARM)
        t["log_failed"] = 0
        for name, value in inputs.items():
            t[name] = value
        self.machine.step(self.ticks)
        if self.obedient and t["send"]:
            self._obey(int(t["controlword"]))
        t["k"] += 1
        return t

    def _obey(self, word: int) -> None:
        following = {
            (DriveState.SWITCH_ON_DISABLED, Controlword.SHUTDOWN): DriveState.READY_TO_SWITCH_ON,
            (DriveState.READY_TO_SWITCH_ON, Controlword.SWITCH_ON): DriveState.SWITCHED_ON,
            (DriveState.SWITCHED_ON, Controlword.ENABLE_OPERATION): DriveState.OPERATION_ENABLED,
            (DriveState.OPERATION_ENABLED, Controlword.QUICK_STOP): DriveState.QUICK_STOP_ACTIVE,
        }
        if word == Controlword.DISABLE_VOLTAGE:
            self.drive = int(DriveState.SWITCH_ON_DISABLED)
        self.drive = int(following.get((DriveState(self.drive), Controlword(word)), DriveState(self.drive)))

    def enable(self) -> Bench:
        for _ in range(10):
            if self.step()["state"] == DriveState.OPERATION_ENABLED:
                return self
        raise AssertionError("the handshake does not end")

    def until_over(
        self, flags: int = FRESH, limit: int = 200, **inputs: float
    ) -> list[tuple[int, int, float, int]]:
        """Step until the supervisor has ended; rows of (state, controlword, |u|, send)."""
        rows = []
        for _ in range(limit):
            t = self.step(flags, **inputs)
            size = abs(float(t["u_q"])) + abs(float(t["u_d"]))
            rows.append((int(t["state"]), int(t["controlword"]), size, int(t["send"])))
            if t["state"] in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT):
                return rows
        raise AssertionError(f"no end after {limit} ticks: {rows[-3:]}")


def make(*overrides: str) -> Bench:
    return Bench(build(load_toml(CONFIGS / "demo.toml", RunConfig, overrides), WIRE))


@pytest.fixture
def bench() -> Bench:
    return make()


def test_nothing_is_sent_before_arming(bench: Bench) -> None:
    for request in (Request.NONE, Request.RAMP_DOWN, Request.STOP, Request.QUICK_STOP):
        t = bench.step(request=int(request))
        assert (t["send"], t["state"]) == (0, DriveState.SWITCH_ON_DISABLED)


def test_handshake_in_order_with_zero_voltage(bench: Bench) -> None:
    seen = []
    for _ in range(5):
        t = bench.step(w_ref=50.0)
        seen.append((int(t["controlword"]), float(t["u_q"])))
        if t["state"] == DriveState.OPERATION_ENABLED:
            break
    words = [word for word, _ in seen]
    assert words == [
        Controlword.SHUTDOWN,
        Controlword.SWITCH_ON,
        Controlword.ENABLE_OPERATION,
        Controlword.ENABLE_OPERATION,
    ]
    assert all(u == 0.0 for _, u in seen[:-1])


def test_a_drive_in_fault_is_reset_by_a_rising_edge(bench: Bench) -> None:
    bench.obedient, bench.drive = False, int(DriveState.FAULT)
    words = [int(bench.step()["controlword"]) for _ in range(4)]
    assert 0x80 in words and any(a & 0x80 == 0 and b & 0x80 for a, b in itertools.pairwise(words))


def test_a_drive_that_never_enables_times_out() -> None:
    bench = make("feedback.enable_timeout_s=0.05")
    bench.obedient = False
    rows = bench.until_over()
    assert bench.t["reason"] == Reason.ENABLE_TIMEOUT and len(rows) > 50
    assert all(u == 0.0 for _, _, u, _ in rows)


STOPS: list[tuple[str, Reason, int, dict[str, float], int]] = [
    # name, reason, flags, inputs, ticks that it is tolerated for
    ("stop asked", Reason.STOP_REQUESTED, FRESH, {"request": int(Request.STOP)}, 0),
    ("quick stop asked", Reason.QUICK_STOP_REQUESTED, FRESH, {"request": int(Request.QUICK_STOP)}, 0),
    ("speed", Reason.OVER_SPEED, FRESH, {"w": 151.0}, 2),
    ("negative speed", Reason.OVER_SPEED, FRESH, {"w": -151.0}, 2),
    ("current", Reason.OVER_CURRENT, FRESH, {"i_q": 16.0, "i_d": 16.0}, 2),
    ("motor hot", Reason.OVER_TEMPERATURE, FRESH, {"temperature_motor": 111.0}, 2),
    ("inverter hot", Reason.OVER_TEMPERATURE, FRESH, {"temperature_inverter": 111.0}, 2),
    ("low dc link", Reason.DC_LINK_UNDER_VOLTAGE, FRESH, {"v_dc": 449.0}, 2),
    ("high dc link", Reason.DC_LINK_OVER_VOLTAGE, FRESH, {"v_dc": 651.0}, 2),
    ("nan", Reason.NOT_A_NUMBER, FRESH, {"w": float("nan")}, 0),
    ("infinite current", Reason.NOT_A_NUMBER, FRESH, {"i_d": float("inf")}, 0),
    ("stale", Reason.STALE_FEEDBACK, 0, {}, 60),
    ("crc", Reason.CRC_ERRORS, FRESH | int(RxFlag.CRC_ERROR), {}, 8),
    ("length", Reason.CRC_ERRORS, FRESH | int(RxFlag.LENGTH_ERROR), {}, 8),
    ("error frames", Reason.CRC_ERRORS, FRESH | int(RxFlag.ERROR_FRAME), {}, 8),
    ("counter", Reason.COUNTER_ERRORS, FRESH | int(RxFlag.COUNTER_JUMP), {}, 8),
    ("repeated counter", Reason.COUNTER_ERRORS, FRESH | int(RxFlag.COUNTER_REPEATED), {}, 8),
    ("bus down", Reason.BUS_DOWN, int(RxFlag.BUS_DOWN), {}, 0),
    ("send failed", Reason.SEND_FAILED, FRESH | int(RxFlag.SEND_FAILED), {}, 0),
    ("foreign command", Reason.FOREIGN_COMMAND, FRESH | int(RxFlag.FOREIGN_COMMAND), {}, 0),
    ("guardian", Reason.GUARDIAN, FRESH | int(RxFlag.GUARDIAN), {}, 0),
    ("guardian lost", Reason.GUARDIAN_LOST, FRESH | int(RxFlag.GUARDIAN_LOST), {}, 0),
    ("log failed", Reason.LOG_FAILED, FRESH, {"log_failed": 1}, 0),
]


@pytest.mark.parametrize(
    ("name", "reason", "flags", "inputs", "tolerated"), STOPS, ids=[row[0] for row in STOPS]
)
def test_every_cause_stops_with_its_reason_and_zero_voltage(
    bench: Bench, name: str, reason: Reason, flags: int, inputs: dict[str, float], tolerated: int
) -> None:
    bench.enable()
    for _ in range(tolerated):
        t = bench.step(flags, **inputs)
        assert t["state"] == DriveState.OPERATION_ENABLED, f"{name}: tripped too early"
    t = bench.step(flags, **inputs)
    assert Reason(int(t["reason"])) == reason
    assert (t["u_q"], t["u_d"], t["T_L"]) == (0.0, 0.0, 0.0)
    rows = bench.until_over(flags, **inputs)
    assert all(u == 0.0 for _, _, u, _ in rows)
    after = [bench.step(request=int(Request.ARM)) for _ in range(3)]
    assert all(t["send"] == 0 and t["state"] != DriveState.OPERATION_ENABLED for t in after), (
        "no automatic resume"
    )


def test_at_the_limit_is_allowed(bench: Bench) -> None:
    bench.enable()
    for _ in range(20):
        t = bench.step(w=150.0, temperature_motor=110.0, v_dc=450.0)
    assert t["state"] == DriveState.OPERATION_ENABLED


def test_an_excess_that_does_not_persist_is_tolerated(bench: Bench) -> None:
    bench.enable()
    for k in range(30):
        t = bench.step(w=151.0 if k % 3 else 0.0)
    assert t["state"] == DriveState.OPERATION_ENABLED


def test_errors_within_the_budget_are_ridden_through(bench: Bench) -> None:
    bench.enable()
    for k in range(100):
        t = bench.step(FRESH | (int(RxFlag.CRC_ERROR) if k % 6 == 0 else 0))
    assert t["state"] == DriveState.OPERATION_ENABLED


def test_stale_feedback_holds_then_quick_stops_then_faults(bench: Bench) -> None:
    bench.enable()
    for _ in range(5):
        bench.step(w_ref=20.0)
    held = float(bench.t["u_q"])
    assert held != 0.0
    for _ in range(60):
        t = bench.step(0, w_ref=20.0)
        assert (float(t["u_q"]), int(t["state"])) == (held, DriveState.OPERATION_ENABLED)
    t = bench.step(0, w_ref=20.0)
    assert (float(t["u_q"]), int(t["state"])) == (0.0, DriveState.QUICK_STOP_ACTIVE)
    rows = bench.until_over(0)
    assert rows[-1][0] == DriveState.FAULT and bench.t["reason"] == Reason.STALE_FEEDBACK


@pytest.mark.parametrize("flag", [RxFlag.BUS_DOWN, RxFlag.GUARDIAN])
def test_with_the_bus_down_or_the_guardian_acting_nothing_more_is_sent(bench: Bench, flag: RxFlag) -> None:
    bench.enable()
    assert bench.step(int(flag))["send"] == 0
    assert all(row[3] == 0 for row in bench.until_over())


@pytest.mark.parametrize(
    ("drive", "reason"),
    [
        (DriveState.FAULT, Reason.DRIVE_FAULT),
        (DriveState.FAULT_REACTION_ACTIVE, Reason.DRIVE_FAULT),
        (DriveState.SWITCHED_ON, Reason.DRIVE_LEFT_OPERATION),
        (DriveState.SWITCH_ON_DISABLED, Reason.DRIVE_LEFT_OPERATION),
    ],
)
def test_a_drive_that_leaves_operation_ends_the_run(bench: Bench, drive: DriveState, reason: Reason) -> None:
    bench.enable()
    bench.obedient, bench.drive = False, int(drive)
    assert bench.step()["reason"] == reason


def test_a_long_gap_is_an_overrun(bench: Bench) -> None:
    bench.enable()
    assert bench.step(gap=20)["state"] == DriveState.OPERATION_ENABLED
    assert bench.step(gap=21)["reason"] == Reason.LOOP_OVERRUN


def test_the_first_reason_stays(bench: Bench) -> None:
    bench.enable()
    bench.step(request=int(Request.STOP))
    bench.step(w=float("nan"), request=int(Request.QUICK_STOP))
    assert bench.t["reason"] == Reason.STOP_REQUESTED


def test_i2t_trips_on_what_a_single_limit_allows() -> None:
    bench = make("limits.i_continuous_a=8.0", "limits.i2t_max_a2s=0.5").enable()
    ticks = 0
    while bench.step(i_q=10.0)["reason"] == Reason.NONE:
        ticks += 1
        assert ticks < 1000
    assert bench.t["reason"] == Reason.I2T
    assert ticks == pytest.approx(0.5 / (36.0 * 1e-3), abs=1.5)  # (10^2 - 8^2) T_s a tick


def test_i2t_recovers_below_the_continuous_current() -> None:
    bench = make("limits.i_continuous_a=8.0", "limits.i2t_max_a2s=0.5").enable()
    for k in range(400):
        t = bench.step(i_q=10.0 if k % 4 == 0 else 0.0)
    assert t["reason"] == Reason.NONE


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy scalars warn where compiled code does not
@pytest.mark.parametrize("seed", range(3))
def test_random_inputs_never_send_voltage_outside_operation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bench = make()
    for trial in range(40):
        bench.machine = bench.machine.fresh()
        bench.drive = int(rng.integers(0, 8))
        for row in _random_rows(rng, 60):
            t = bench.step(**row)
            limit = 300.0 + 1e-9
            assert np.hypot(t["u_q"], t["u_d"]) <= limit, f"seed {seed} trial {trial}"
            if t["state"] != DriveState.OPERATION_ENABLED or not t["send"]:
                assert (t["u_q"], t["u_d"], t["T_L"]) == (0.0, 0.0, 0.0) or t["send"] == 0, f"seed {seed}"


def _random_rows(rng: np.random.Generator, count: int) -> Iterable[dict[str, Any]]:
    strange = [np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 0.0, 100.0, -3.0]
    for _ in range(count):
        odd = rng.random() < 0.2
        yield {
            "flags": FRESH if rng.random() < 0.8 else int(rng.integers(0, 1 << 11)),
            "gap": int(rng.integers(1, 4)),
            "w": rng.choice(strange) if odd else rng.normal(0, 50),
            "i_q": rng.choice(strange) if odd else rng.normal(0, 5),
            "w_ref": rng.choice(strange) if odd else 50.0,
            "request": int(rng.choice([1, 1, 1, 1, 3, 4])) if rng.random() < 0.02 else 1,
        }


def test_lost_feedback_does_not_undo_a_step_of_the_handshake(bench: Bench) -> None:
    """Another word than the last would take the drive back while the controller thinks that it is on."""
    words = []
    for k in range(12):
        flags = 0 if k % 2 else FRESH
        t = bench.step(flags)
        words.append((int(t["state"]), int(t["controlword"])))
        if t["state"] == DriveState.OPERATION_ENABLED:
            break
    assert words[-1][0] == DriveState.OPERATION_ENABLED, words
    sent = [word for _, word in words]
    assert sent == sorted(sent), words  # 0x06, 0x07, 0x0F and never back


def echoing(bench: Bench, ticks: int, echo_of: Any) -> list[int]:
    """Reasons over ticks whose echo the test makes from the last sent counter."""
    bench.enable()
    out = []
    for k in range(ticks):
        counter = int(bench.t["counter"])
        out.append(int(bench.step(echo=echo_of(counter, k))["reason"]))
    return out


def test_a_drive_that_no_longer_gets_the_commands_is_left() -> None:
    stuck = echoing(make("feedback.hold_ticks=40"), 60, lambda counter, k: 7)  # the counter comes round to 7
    assert stuck.index(Reason.COMMAND_LOST) in (39, 40, 41)
    late = echoing(make("feedback.hold_ticks=5"), 20, lambda counter, k: (counter - 3) % 16)
    assert late.index(Reason.COMMAND_LOST) == 5
    once = echoing(make("feedback.hold_ticks=5"), 200, lambda c, k: (c - (k % 5 == 0)) % 16)
    assert not any(once)


def test_an_echo_of_a_drive_with_its_own_clock_may_be_behind() -> None:
    cyclic = make("feedback.hold_ticks=5", 'loop.pacing="feedback"')
    assert not any(echoing(cyclic, 50, lambda counter, k: (counter - 2) % 16))


def test_a_speed_that_is_lost_stops_after_its_time() -> None:
    bench = make("limits.following_error_rad_s=10.0", "limits.following_error_s=0.05").enable()
    reasons = [int(bench.step(w_ref=40.0, w=29.0 + 0.01 * (k % 3))["reason"]) for k in range(60)]
    assert reasons.index(Reason.FOLLOWING_ERROR) == 49
    near = make("limits.following_error_rad_s=10.0", "limits.following_error_s=0.05").enable()
    assert not any(int(near.step(w_ref=40.0, w=31.0 + 0.01 * (k % 3))["reason"]) for k in range(100))


def test_a_d_current_that_is_mostly_large_stops() -> None:
    own = ("limits.i_d_max_a=2.0", "limits.open_phase_min_a=100.0")
    bench = make(*own).enable()
    swing = [4.0 * np.sin(0.4 * k) for k in range(600)]  # |i_d| > 2 A in two ticks of three
    reasons = [int(bench.step(i_d=i_d)["reason"]) for i_d in swing]
    assert Reason.CURRENT_UNCONTROLLED in reasons and reasons.index(Reason.CURRENT_UNCONTROLLED) > 200
    bench = make(*own).enable()
    assert not any(int(bench.step(i_d=2.3 * np.sin(0.4 * k))["reason"]) for k in range(600))


def test_an_open_phase_stops_at_light_load_too() -> None:
    """The current stays on one stator axis while the rotor turns by 0.2 rad a tick."""

    def reasons(amplitude: float, share: float = 1.0) -> list[int]:
        bench = make("limits.i_d_max_a=2.0", "limits.open_phase_min_a=0.2").enable()
        angles = [0.2 * k for k in range(600)]
        return [
            int(bench.step(i_q=amplitude * np.cos(a) + 1e-3 * a, i_d=share * amplitude * np.sin(a))["reason"])
            for a in angles
        ]

    assert 100 < reasons(1.0).index(Reason.CURRENT_UNCONTROLLED) < 300
    assert not any(reasons(0.19))  # too little to tell
    assert not any(reasons(1.0, share=0.2))  # a d current that is small beside the q current


def test_a_shadow_run_is_not_stopped_by_what_another_controller_does() -> None:
    from hil.config.design import safety_params

    config = load_toml(CONFIGS / "demo.toml", RunConfig, ["loop.shadow=true", "limits.i_d_max_a=2.0"])
    p = safety_params(config, WIRE)[0]
    assert np.isinf(p["w_error_max"]) and np.isinf(p["i_d_max"]) and np.isinf(p["open_phase_min"])
