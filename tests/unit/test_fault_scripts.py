"""Fault scripts: mistakes are named, and each injector does what it says, on frames and on the plant."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.bus import BusSettings, Frame, open_link
from drivers.codec import Database
from drivers.local import ERR_FLAG
from drivers.lockstep import TICK_OVER, LockstepLink, tick_over
from firmware_model.config import PlantConfig, build_params, new_sample, new_state
from firmware_model.faulty_link import FaultyLink
from firmware_model.faulty_plant import PlantFaults, project, turned
from firmware_model.node import wire_of
from firmware_model.plant import ANGLE, State
from hil.config.tables import load_toml
from hil.errors import ConfigError
from hil.faults.matrix import Matrix, chosen, inline, load_matrix
from tests.conftest import CONFIGS

DATABASE = Database(CONFIGS / "drives" / "hil_pmsm.dbc")
FEEDBACK = DATABASE.message("FEEDBACK")
PLANT = CONFIGS / "plants" / "demo.toml"


class Ends:
    """A link whose two ends are lists."""

    def __init__(self) -> None:
        self.sent: list[Frame] = []
        self.waiting: list[Frame] = []

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        self.sent.append(Frame(can_id & 0x1FFFFFFF, data, can_id & ~0x1FFFFFFF, fd))

    def receive(self, timeout_ns: int) -> Frame | None:
        return self.waiting.pop(0) if self.waiting else None

    def discard(self) -> int:
        return 0

    def close(self) -> None:
        pass


def faults(*given: dict[str, Any]) -> Any:
    return load_toml(PLANT, PlantConfig, [f"fault={inline(list(given))}"]).fault


class Bench:
    """A faulty link whose plant time the test sets."""

    def __init__(self, *given: dict[str, Any], lockstep: bool = False) -> None:
        self.t_ns, self.ends, self.lost = 0, Ends(), 0
        self.link = FaultyLink(self.ends, DATABASE, faults(*given), lockstep=lockstep)
        self.link.now_ns, self.link.lost_sync = lambda: self.t_ns, self._lose

    def _lose(self) -> None:
        self.lost += 1

    def feedback(self, counter: int) -> bytes:
        """Send one FEEDBACK a millisecond after the last; return its bytes as they were."""
        data = FEEDBACK.encode({"Counter": counter % 16, "Speed": 1.0, "State": 4})
        self.link.send(FEEDBACK.can_id, data)
        self.t_ns += 1_000_000
        return data

    def counters(self) -> list[int]:
        return [frame.data[1] & 15 for frame in self.ends.sent]


def test_nothing_happens_outside_the_window() -> None:
    bench = Bench({"kind": "drop", "at_s": 0.002, "for_s": 0.003})
    for counter in range(8):
        bench.feedback(counter)
    assert bench.counters() == [0, 1, 5, 6, 7]


def test_what_a_fault_did_is_counted_by_its_place_in_the_script() -> None:
    acted = Counter[int]()
    script = faults({"kind": "drop", "at_s": 1.0}, {"kind": "duplicate", "at_s": 0.0, "for_s": 0.002})
    bench = Bench()
    bench.link = FaultyLink(bench.ends, DATABASE, script, lockstep=False, acted=acted)
    bench.link.now_ns = lambda: bench.t_ns
    for counter in range(4):
        bench.feedback(counter)
    assert (acted[0], acted[1]) == (0, 2)


def test_a_share_is_drawn_from_the_seed() -> None:
    def passed(seed: int) -> list[int]:
        bench = Bench({"kind": "drop", "at_s": 0.0, "share": 0.25, "seed": seed})
        for counter in range(400):
            bench.feedback(counter)
        return bench.counters()

    assert passed(5) == passed(5) != passed(6)
    assert 250 < len(passed(5)) < 350


def test_delay_duplicate_reorder() -> None:
    late = Bench({"kind": "delay", "at_s": 0.0, "delay_ms": 2.0})
    twice = Bench({"kind": "duplicate", "at_s": 0.0})
    swapped = Bench({"kind": "reorder", "at_s": 0.0})
    for counter in range(4):
        for bench in (late, twice, swapped):
            bench.feedback(counter)
    assert late.counters() == [0, 1]
    assert twice.counters() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert swapped.counters() == [1, 0, 3, 2]


def test_corruption_flips_that_many_bits_and_the_crc_tells() -> None:
    bench = Bench({"kind": "corrupt", "at_s": 0.0, "bits": 3})
    whole = bench.feedback(1)
    damaged = bench.ends.sent[0].data
    flipped = int.from_bytes(whole, "little") ^ int.from_bytes(damaged, "little")
    assert flipped.bit_count() == 3 and not FEEDBACK.valid(damaged)


def test_a_frozen_counter_has_a_good_crc() -> None:
    bench = Bench({"kind": "frozen-counter", "at_s": 0.0})
    for counter in (3, 4, 5):
        bench.feedback(counter)
    assert bench.counters() == [3, 3, 3]
    assert all(FEEDBACK.valid(frame.data) for frame in bench.ends.sent)


def test_bus_off_is_told_by_one_error_frame_and_cuts_both_directions(channel: str) -> None:
    settings = BusSettings("hil-local", channel)
    with closing(open_link(settings)) as node, closing(open_link(settings)) as other:
        bench = Bench({"kind": "bus-off", "at_s": 0.0, "for_s": 0.002})
        bench.link = FaultyLink(
            node, DATABASE, faults({"kind": "bus-off", "at_s": 0.0, "for_s": 0.002}), lockstep=False
        )
        bench.link.now_ns = lambda: bench.t_ns
        other.send(0x201, bytes(8))
        bench.feedback(0)
        assert bench.link.receive(1_000_000) is None, "the command is cut"
        for counter in (1, 2):
            bench.feedback(counter)
        heard = [other.receive(100_000_000) for _ in range(2)]
        assert [(frame.can_id, frame.flags) for frame in heard if frame] == [
            (0x40, ERR_FLAG),
            (FEEDBACK.can_id, 0),
        ]
        assert other.receive(0) is None


def test_frames_to_the_drive_have_faults_too_and_a_lost_sync_lets_time_pass() -> None:
    bench = Bench({"kind": "drop", "at_s": 0.0, "message": "SYNC"}, lockstep=True)
    bench.ends.waiting = [Frame(0x80, b"\x07", 0, False), Frame(0x201, bytes(8), 0, False)]
    assert bench.link.receive(0) is None and bench.lost == 1
    frame = bench.link.receive(0)
    assert frame is not None and frame.can_id == 0x201
    over = bench.ends.sent[-1]
    assert (over.can_id | over.flags, over.data) == (TICK_OVER, b"\x07")


def test_once_a_tick_is_over_nobody_waits_for_more_of_it() -> None:
    """Of two clients of one link the second has nothing to wait for either."""
    waits: list[int] = []

    class Timed(Ends):
        def receive(self, timeout_ns: int) -> Frame | None:
            waits.append(timeout_ns)
            return super().receive(timeout_ns)

    ends = Timed()
    link = LockstepLink(ends, 0x80)
    assert link.receive(7) is None and waits == [7]
    link.send(0x80, b"")
    can_id, data = tick_over(b"")
    ends.waiting = [Frame(can_id & 0x1FFFFFFF, data, can_id & ~0x1FFFFFFF, False)]
    assert link.receive(7) is None and link.receive(7) is None and waits == [7, 7, 0]
    ends.waiting = [Frame(0x185, b"", 0, False)]
    assert link.receive(7) == Frame(0x185, b"", 0, False), "what is there is read"
    link.send(0x80, b"")
    assert link.receive(7) is None and waits[-1] == 7


def test_a_lockstep_link_ends_the_wait_with_its_own_tick_and_hides_it() -> None:
    ends = Ends()
    link = LockstepLink(ends, 0x80)
    old, now = (Frame(0x1FFFFFFE, sync, TICK_OVER & ~0x1FFFFFFF, False) for sync in (b"\x01", b"\x02"))
    link.send(0x80, b"\x02")
    ends.waiting = [old, Frame(0x181, bytes(8), 0, False), now, Frame(0x281, bytes(8), 0, False)]
    seen = [link.receive(1), link.receive(1), link.receive(1)]
    assert [frame and frame.can_id for frame in seen] == [0x181, None, 0x281]
    assert tick_over(b"\x02") == (TICK_OVER, b"\x02")


def test_of_two_syncs_alike_the_end_of_the_first_does_not_end_the_second() -> None:
    """A command that is its own SYNC has no counter: an end that comes late is not the next one's."""
    ends = Ends()
    link = LockstepLink(ends, 0x80)
    over = Frame(0x1FFFFFFE, b"\x02", TICK_OVER & ~0x1FFFFFFF, False)
    answer = Frame(0x181, bytes(8), 0, False)
    link.send(0x80, b"\x02")
    ends.waiting = [answer]
    assert [link.receive(1), link.receive(0)] == [answer, None]  # no end seen yet: nothing to wait for
    link.send(0x80, b"\x02")
    ends.waiting = [over, answer, over, answer]
    assert [link.receive(1), link.receive(1), link.receive(1)] == [answer, None, answer]
    link.send(0x80, b"\x02")
    ends.waiting = [over]
    assert link.discard() == 1
    link.send(0x80, b"\x02")
    ends.waiting = [over, answer]
    assert [link.receive(1), link.receive(1)] == [None, answer]


def plant(*given: dict[str, Any], w: float = 50.0) -> tuple[Any, Any, PlantFaults]:
    """State (enabled, turning), sample, faults."""
    config = load_toml(PLANT, PlantConfig, [f"fault={inline(list(given))}"])
    params = build_params(config, wire_of(DATABASE))
    state = new_state(params, 15)
    state["started"], state["state"], state["x"][0, 0] = 1, State.OPERATION_ENABLED.value, w
    return state[0], new_sample()[0], PlantFaults(config.fault, params, 15)


@pytest.mark.long
def test_an_open_phase_carries_no_current() -> None:
    s, _, own = plant({"kind": "phase-loss", "at_s": 0.0})
    s["u_q"], s["u_d"] = 130.0, 5.0
    theta = 0.0
    for _ in range(40):
        before = float(s["x"][0])
        own.advance(s, 50_000)
        theta += 3 * 0.5 * (before + float(s["x"][0])) * 50e-6
        i_q, i_d = float(s["x"][1]), float(s["x"][2])
        assert abs(i_d * math.cos(theta) - i_q * math.sin(theta)) < 1e-9
    assert math.hypot(i_q, i_d) > 0.1


def test_projection_keeps_the_beta_component() -> None:
    x = np.array([0.0, 3.0, -2.0])
    project(x, 0.7)
    beta = -2.0 * math.sin(0.7) + 3.0 * math.cos(0.7)
    assert x[2] * math.sin(0.7) + x[1] * math.cos(0.7) == pytest.approx(beta)


def test_encoder_slip_turns_voltage_and_current_against_each_other() -> None:
    s, out, own = plant({"kind": "encoder-slip", "at_s": 0.0, "angle_deg": 90.0})
    s["u_q"], s["u_d"], out["i_q"], out["i_d"] = 10.0, 0.0, 0.0, 2.0
    own.after(s, out)
    assert (s["u_q"], s["u_d"]) == pytest.approx((0.0, -10.0), abs=1e-12)
    assert (out["i_q"], out["i_d"]) == pytest.approx((-2.0, 0.0), abs=1e-12)
    assert turned(*turned(1.0, 2.0, 0.3), -0.3) == pytest.approx((1.0, 2.0))


@pytest.mark.parametrize("kind", ["encoder-reversed", "phase-swap"])
@pytest.mark.parametrize("theta", [0.0, 0.2, -1.1])
def test_a_mirrored_drive_has_the_torque_of_its_mirror_image(kind: str, theta: float) -> None:
    """By hand over a, b, c: out by the drive's angle, two of them exchanged, back by the true one."""
    s, out, own = plant({"kind": kind, "at_s": 0.0})
    s["series"][ANGLE, 0], s["u_q"], s["u_d"] = theta, 10.0, 3.0
    out["w"], out["i_q"], out["i_d"] = 20.0, 2.0, 1.0
    own.after(s, out)
    its = -3 * theta if kind == "encoder-reversed" else 3 * theta  # 3 pole pairs
    u, i = phases(10.0, 3.0, its), phases(2.0, 1.0, 3 * theta)
    if kind == "phase-swap":
        u, i = u[[0, 2, 1]], i[[0, 2, 1]]
    assert (s["u_q"], s["u_d"]) == pytest.approx(dq(u, 3 * theta))
    assert (out["i_q"], out["i_d"]) == pytest.approx(dq(i, its), abs=6e-3)
    assert out["w"] == (-20.0 if kind == "encoder-reversed" else 20.0)
    assert own._params[0]["turns"] == 1


SHIFTS = np.array([0.0, -2.0, 2.0]) * math.pi / 3.0


def phases(q: float, d: float, angle: float) -> np.ndarray:
    return d * np.cos(angle + SHIFTS) - q * np.sin(angle + SHIFTS)


def dq(abc: np.ndarray, angle: float) -> tuple[float, float]:
    q, d = -2 / 3 * abc @ np.sin(angle + SHIFTS), 2 / 3 * abc @ np.cos(angle + SHIFTS)
    return float(q), float(d)


def test_bias_and_frozen_values_stand_on_the_grid_of_the_wire() -> None:
    s, out, own = plant({"kind": "bias", "at_s": 0.0, "w_rad_s": -3.004, "i_d_a": 100.0})
    out["w"] = 50.0
    own.after(s, out)
    assert out["w"] == pytest.approx(47.0) and out["i_d"] == pytest.approx(20.47)
    s, out, own = plant({"kind": "frozen-value", "at_s": 0.0})
    for w in (50.0, 51.0, 52.0):
        out["w"] = w
        own.after(s, out)
        assert out["w"] == 50.0


def test_supply_noise_and_heat_come_and_go() -> None:
    given = (
        {"kind": "dc-link", "at_s": 0.001, "for_s": 0.001, "v_dc_v": 300.0},
        {"kind": "noise", "at_s": 0.001, "for_s": 0.001, "w_noise_rad_s": 9.0},
        {"kind": "over-temperature", "at_s": 0.001, "for_s": 0.002, "rate_k_s": 1000.0},
    )
    s, _, own = plant(*given)
    p, seen = own._params[0], []
    for t_ns in range(0, 5_000_000, 1_000_000):
        s["t_ns"] = t_ns
        own.before(s)
        seen.append((float(p["v_dc"]), float(p["w_noise"]), round(float(s["temperature"]))))
    assert seen == [(540, 0.01, 25), (300, 9.0, 26), (540, 0.01, 27), (540, 0.01, 27), (540, 0.01, 27)]


def test_a_brown_out_boots_the_firmware_and_leaves_the_rotor_turning() -> None:
    s, _, own = plant({"kind": "brown-out", "at_s": 0.001, "for_s": 0.002})
    s["u_q"], s["x"][1], s["echo"] = 50.0, 4.0, 3
    booted = []
    for t_ns in range(0, 5_000_000, 1_000_000):
        s["t_ns"] = t_ns
        booted.append(own.before(s))
    assert booted == [False, False, False, True, False]
    assert (s["state"], s["u_q"], s["x"][1], s["echo"]) == (State.SWITCH_ON_DISABLED, 0.0, 0.0, 15)
    assert s["x"][0] == 50.0 and s["started"] == 1


@pytest.mark.parametrize(
    ("idle", "acting"),
    [
        ({"kind": "dc-link", "v_dc_v": 540.0}, {"kind": "dc-link", "v_dc_v": 539.0}),
        ({"kind": "bias"}, {"kind": "bias", "i_q_a": 0.5}),
        ({"kind": "encoder-slip", "angle_deg": 0.0}, {"kind": "encoder-slip", "angle_deg": 5.0}),
        ({"kind": "load", "torque_n_m": 0.0}, {"kind": "load", "torque_n_m": 1.0}),
        ({"kind": "noise", "w_noise_rad_s": 0.01, "i_noise_a": 0.002}, {"kind": "noise"}),
    ],
)
def test_a_fault_of_the_plant_that_changes_nothing_has_not_acted(
    idle: dict[str, Any], acting: dict[str, Any]
) -> None:
    s, out, own = plant({**idle, "at_s": 0.0}, {**acting, "at_s": 0.0})
    out["w"], out["i_q"], out["i_d"], s["u_q"] = 50.0, 2.0, 0.0, 100.0
    own.before(s)
    own.after(s, out)
    kind = idle["kind"]
    assert own.box.as_dict(s)["acted"] == [[kind, 0], [kind, 1]]


def test_an_open_phase_without_current_has_not_acted() -> None:
    s, _, own = plant({"kind": "phase-loss", "at_s": 0.0})
    s["state"] = State.SWITCH_ON_DISABLED
    own.advance(s, 1_000_000)
    assert own.acted[0] == 0
    s["state"], s["u_q"] = State.OPERATION_ENABLED, 150.0
    own.advance(s, 1_000_000)
    assert own.acted[0] == 1


def test_the_load_fault_is_one_more_load() -> None:
    config = load_toml(PLANT, PlantConfig, ['fault=[{kind="load", at_s=1.0, for_s=0.5, torque_n_m=40.0}]'])
    assert config.all_loads[-1].model_dump() == {
        "kind": "step", "torque_n_m": 40.0, "at_s": 1.0, "until_s": 1.5
    }  # fmt: skip


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ({"kind": "drop", "at_s": -1.0}, "greater than or equal to 0"),
        ({"kind": "drop", "at_s": 1.0, "share": 0.0}, "greater than 0"),
        ({"kind": "drop", "at_s": 1.0, "shares": 0.5}, "unknown key"),
        ({"kind": "brown-out", "at_s": 1.0}, "missing"),
        ({"kind": "gremlin", "at_s": 1.0}, "gremlin"),
    ],
)
def test_a_mistake_in_a_script_is_said(script: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as raised:
        faults(script)
    assert said in str(raised.value)


def matrix_file(folder: Path, text: str) -> Path:
    path = folder / "m.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_all_mistakes_of_a_matrix_are_said_at_once(tmp_path: Path) -> None:
    text = """
    [[row]]
    name = "a"
    expect = { reaction = "stop", reason = ["no_such"], within_ms = 1.0 }
    [[row]]
    name = "b"
    expect = { reaction = "stop" }
    [[row]]
    name = "c"
    host = { kind = "stall", at_s = 0.1, for_ms = 0 }
    expect = { reaction = "ride through", within_ms = 3.0 }
    """
    with pytest.raises(ConfigError) as raised:
        load_toml(matrix_file(tmp_path, text), Matrix)
    problems = "\n".join(raised.value.problems)
    assert len(raised.value.problems) == 4
    for said in ("no_such: no reason", "a stop needs reason and within_ms", "for_ms", "has no reason"):
        assert said in problems


def test_mistakes_in_the_rows_scripts_are_said_for_all_rows(configs: Path, tmp_path: Path) -> None:
    from hil.faults.case import check_rows

    text = """
    [[row]]
    name = "first"
    fault = [{ kind = "drop", at_s = 0.1, message = "NOBODY" }]
    expect = { reaction = "ride through" }
    [[row]]
    name = "second"
    fault = [{ kind = "delay", at_s = 0.1 }]
    expect = { reaction = "ride through" }
    """
    matrix = load_toml(matrix_file(tmp_path, text), Matrix)
    with pytest.raises(ConfigError) as raised:
        check_rows(configs / "demo.toml", matrix, matrix.row)
    assert "row 'first'" in str(raised.value) and "NOBODY" in str(raised.value)
    assert "row 'second'" in str(raised.value) and "delay_ms" in str(raised.value)


def test_a_run_configuration_gets_the_shipped_matrix(configs: Path) -> None:
    shipped = configs / "faults.toml"
    matrix, path = load_matrix(configs / "vcan0.toml", shipped)
    assert path.name == "vcan0.toml" and len(matrix.row) > 30
    assert load_matrix(shipped, shipped)[1] == configs / "demo.toml"
    with pytest.raises(ConfigError, match="no such row"):
        chosen(matrix, ["nothing like it"])


def test_inline_toml_is_read_back(tmp_path: Path) -> None:
    import tomllib

    value = [{"a": 1, "b": 0.5, "c": 'x"y', "d": True, "e": [1.0, 2.0]}]
    assert tomllib.loads(f"v = {inline(value)}")["v"] == value


def test_a_simulation_refuses_a_fault_script(configs: Path) -> None:
    from hil.runtime.setup import Overrides, load_setup
    from hil.sim.simulate import make_simulation

    setup = load_setup(configs / "demo.toml", Overrides())
    with pytest.raises(ConfigError, match="needs the bus"):
        make_simulation(setup, ['fault=[{kind="drop", at_s=0.1}]'])


@pytest.mark.parametrize(
    "fault", ['kind="encoder-slip",angle_deg=90.0', 'kind="encoder-reversed"', 'kind="phase-swap"']
)
def test_what_turns_a_commanded_voltage_needs_one(fault: str) -> None:
    with pytest.raises(ConfigError, match="acts on a commanded voltage, this drive takes a current"):
        load_toml(CONFIGS / "plants" / "current.toml", PlantConfig, [f"fault=[{{at_s=0.0,{fault}}}]"])
