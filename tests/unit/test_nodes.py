"""Several nodes on one bus, without a bus: the list of drives, a torque law, one shaft, link and file."""

from __future__ import annotations

import math
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from drivers.bus import BusSettings, Frame, SocketLink, open_link
from drivers.errors import LinkError
from drivers.hub import READ_MOST, Hub, heard_ids, links_of
from drivers.local import EFF_FLAG, ERR_FLAG, RTR_FLAG, pack_frame
from firmware_model.bench import Bench
from firmware_model.config import PlantConfig, Record, Wire, build_params, new_state
from firmware_model.drive import advance
from firmware_model.plant import ANGLE, State
from firmware_model.registry import PlantError
from firmware_model.shaft import advance_both, couple, refuse_uncoupled
from hil.check.filtered import filter_rows
from hil.config.nodefile import load_nodes
from hil.config.tables import RunConfig, load_toml
from hil.control.errors import ControlDesignError
from hil.control.law import ask, new_law_state
from hil.errors import ConfigError
from hil.log.mcapfile import RunFile
from hil.log.reader import open_log
from hil.runtime.bus import deaf
from hil.runtime.noderules import exchange
from hil.runtime.nodes import NodesLoop
from hil.runtime.nodesetup import load_node_setups, nodes_load
from hil.runtime.refusals import load_found
from hil.runtime.rules import new_pace
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, RxFlag, new_ticks
from hil.sim.emulate import make_bench
from hil.tick.pair import ask as ask_load
from hil.tick.pair import tell
from tests.conftest import CONFIGS

DYNO = CONFIGS / "dyno.toml"
FAC = CONFIGS / "dyno-fac.toml"
WIRE = Wire(0.0, 1e9, 0.0, 1e9, 0.0, 1e9)


def setups_of(*settings: str) -> Any:
    return load_node_setups(DYNO, Overrides(settings=settings))


def test_each_node_is_a_whole_configuration() -> None:
    setups = setups_of("drive.1.limits.i_max_a=3.0")
    motor, load = setups.values()
    assert list(setups) == ["motor", "load"]
    assert (motor.config.drive.node_id, load.config.drive.node_id) == (5, 6)
    assert (motor.config.limits.i_max_a, load.config.limits.i_max_a) == (10.0, 3.0)
    assert motor.config.motor == load.config.motor, "what stands at the top is for both"
    assert motor.config.criteria.dip_max_rad_s == 2.5 and load.config.criteria.dip_max_rad_s is None


def test_a_command_for_one_drive_takes_one_node() -> None:
    config = load_toml(DYNO, RunConfig, ["node=load"])
    assert config.drive.node_id == 6 and config.controller.kind == "torque"
    assert load_nodes(DYNO, ["node=load"]) is None
    assert (
        load_nodes(CONFIGS / "cia402.toml") is None
        and load_node_setups(CONFIGS / "demo.toml", Overrides()) is None
    )
    with pytest.raises(ConfigError, match=r"drive: is a list of nodes.*--set node=motor or --set node=load$"):
        load_toml(DYNO, RunConfig)
    with pytest.raises(ConfigError, match="node: there is no 'lod'; take --set node=motor"):
        load_setup(DYNO, Overrides(settings=("node=lod",)))


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("drive.1.node_id=5", r"drive.node_id: motor \(5\) and load \(5\) have the same .*0x185 TPDO1"),
        ('drive.1.name="motor"', "drive.1.name: 'motor' is the first node's too; give each its own"),
        ('drive.1.name="Load 1"', "drive.1.name: 'Load 1' is no name; take small letters"),
        ("drive.0.limits.i_max_a=-1.0", "node motor: limits.i_max_a: "),
        ("drive.1.limits.imax=1.0", "node load: limits.imax: unknown key"),
        ('drive.1.kind="query"', "node load: drive.kind: 'query' is not one of"),
        ('loop.pacing="feedback"', 'loop.pacing: several nodes answer one SYNC; take "sync"'),
        ("loop.shadow=true", "loop.shadow: not with several nodes; take one: --set node=NAME"),
        ("feedback.period_ms=2.0", "motor: feedback.period_ms: several nodes measure in each tick"),
        ("log.split_s=2.0", "log.split_s, log.split_mb: a log of several nodes is one file"),
        ('drive.1.controller.torque_n_m=[1.0]', "controller: torque_n_m has 1 entries and for_s 3"),
        ('drive.1.controller.kind="cascade"', "node load: "),
        ("drive.1.signals.sync=", "node load: "),
    ],
)  # fmt: skip
def test_what_is_refused_is_said_in_one_line(setting: str, said: str) -> None:
    with pytest.raises(Exception, match=said) as caught:
        setups_of(setting)
    assert "\n" not in str(caught.value) or "kind" in setting or "period" in setting, str(caught.value)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ('drive.1.controller={kind="torque", torque_n_m=[0.0], for_s=[1.0]}',
         "controller.kind: motor fac; one law over both is fac on the drive under test and follow on"),
        ('drive.0.controller={kind="follow"}', "controller.kind: motor follow and load follow; one law over"),
        ("drive.1.current_lag_ms=2.0", "drive.current_lag_ms: 1 and 2; the law fac moves both drives as one"),
        ("drive.0.delay_ticks=1", "drive.delay_ticks: 1 and 0; the law fac moves both drives as one"),
        ("drive.0.limits.T_L_max_n_m=0.0", "limits.T_L_max_n_m = 0 of the law fac: must be positive and"),
        ("drive.1.limits.i_max_a=4.0", "limits.T_L_max_n_m = 18 of .* the limits of load allow, 14.4 N m"),
        ('drive.1.signals.torque=""', "load: reports neither i_q nor torque, which fac is told"),
        ('drive.0.signals.torque=""', "controller.kind fac: the drive reports neither i_q nor torque"),
        ("drive.0.motor={R_s_ohm=2.875, L_d_h=0.033, L_q_h=0.033, psi_f_wb=0.8, n_p=3, J_kg_m2=0.011, "
         "B_f_n_m_s=2e-4}", "motor.J_kg_m2: 0.011 and 0.022; both are on one shaft"),
        ("motor.shaft={resonance_hz=90.0, damping_ratio=0.02, inertia_ratio=1.0}",
         "motor.shaft: the law fac commands the load itself, without a shaft in its model"),
    ],
)  # fmt: skip
def test_what_one_law_over_both_needs_is_said(setting: str, said: str) -> None:
    with pytest.raises((ConfigError, ControlDesignError), match=said) as caught:
        load_node_setups(FAC, Overrides(settings=(setting,)))
    assert len(str(caught.value).splitlines()) <= 2, str(caught.value)


@pytest.mark.parametrize("node", ["motor", "load"])
def test_half_of_a_law_is_none_for_one_drive(node: str) -> None:
    with pytest.raises(ConfigError, match="half of one law over two nodes, and this takes one drive"):
        load_setup(FAC, Overrides(settings=(f'node="{node}"',)))


def test_two_drives_are_one_to_the_law_over_both() -> None:
    """Exact drives with lag on one shaft: an unknown load is known, w* is held but for the steps of the wire.

    The plant here is scipy's exponential of (w, i_motor, i_load), which shares nothing with the kernels.
    """
    ramp = 'drive.0.reference={kind="ramp", w_rad_s=40.0, rate_rad_s2=400.0, at_s=0.05, i_q_a=1.5}'
    setups = load_node_setups(FAC, Overrides(settings=(ramp,)))
    assert setups is not None
    machines = [one.machine.fresh() for one in setups.values()]
    J, B, k_t, tau, T_s = 0.022, 4e-4, 3.6, 1e-3, 1e-3
    A = np.array([[-B / J, k_t / J, k_t / J], [0.0, -1.0 / tau, 0.0], [0.0, 0.0, -1.0 / tau]])
    held = np.zeros((6, 6))
    held[:3, :3], held[:3, 3:] = A * T_s, np.diag([-1.0 / J, 1.0 / tau, 1.0 / tau]) * T_s
    Ad, Bd = (expm(held)[:3, part] for part in (slice(3), slice(3, 6)))
    ticks, x, commands = [new_ticks() for _ in machines], np.zeros(3), np.zeros(2)
    for machine in machines:
        machine.law_state["started"] = 0
    errors, known = [], []
    for k in range(1500):
        load_torque = 0.0 if k < 700 else 5.4
        for tick, machine, i in zip(ticks, machines, x[1:], strict=True):
            t = tick[0]
            t["rx_flags"], t["gap"], t["missing"] = int(RxFlag.FRESH), 1, 0
            t["drive_state"], t["w"], t["i_q"] = int(DriveState.OPERATION_ENABLED), x[0], i
            t["echo"] = t["counter"]
            machine.safety_state["state"] = int(DriveState.OPERATION_ENABLED)
        motor, load = ticks
        tell(motor, load, machines[1].law)
        for tick, machine in zip(ticks, machines, strict=True):
            if tick is load:
                ask_load(motor, load, machines[1].law)
            machine.prepare(tick)
            machine.step(tick)
        x = Ad @ x + Bd @ np.array([load_torque, *commands])
        commands = np.array([tick["u_q"][0] / k_t for tick in ticks])
        errors.append(x[0] - motor["w_ref"][0])
        known.append(-J * motor["d_hat_w"][0])
    assert {int(tick["reason"][0]) for tick in ticks} == {0}
    assert known[690] == pytest.approx(0.0, abs=1e-3) and known[1490] == pytest.approx(5.4, abs=1e-3)
    assert abs(errors[1490]) < 6e-3, "what two steps of the wire, 0.01 and 0.007 N m, move"
    assert max(map(abs, errors[705:715])) > 0.5 and max(map(abs, errors[780:])) < 0.02


@pytest.mark.parametrize(("count", "said"), [(1, "not of 1"), (3, "not of 3")])
def test_a_list_is_of_two(tmp_path: Path, count: int, said: str) -> None:
    text = DYNO.read_text(encoding="utf-8")
    head, first, second = text.split("[[drive]]")
    entries = [first, second, second.replace('"load"', '"third"')][:count]
    path = tmp_path / "dyno.toml"
    path.write_text("[[drive]]".join([head, *entries]), encoding="utf-8")
    with pytest.raises(ConfigError, match=f"drive: a list of 2 tables .*{said}; one drive alone is"):
        load_node_setups(path, Overrides())


def test_an_entry_without_a_name(tmp_path: Path) -> None:
    path = tmp_path / "dyno.toml"
    path.write_text(DYNO.read_text(encoding="utf-8").replace('name = "load"\n', ""), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"drive.1.name: missing; take small letters and digits, as load"):
        load_node_setups(path, Overrides())


def test_the_bus_load_counts_sync_once() -> None:
    """docs/drives/cia402.md: two drives take 51.6 % at 1 kHz; what an emulator adds is told beside it."""
    found, good = nodes_load(setups_of())
    assert found.count("SYNC") == 1 and found.count("TPDO1") == found.count("RPDO1") == 2
    assert found.startswith("52 % at 1000000 bit/s") and good
    assert found.endswith("; 19 % more by load TPDO2, motor TPDO2, which no real drive sends")
    slow, good = nodes_load(setups_of("bus.bitrate=500000"))
    assert slow.startswith("103 % at 500000 bit/s") and not good
    assert (
        "more by"
        not in load_found(
            load_setup(CONFIGS / "odrive.toml", Overrides(settings=('drive.signals.load_true=""',)))
        )[0]
    )


def test_a_torque_by_its_table() -> None:
    """Rows end by their time, the torque goes there at its slew, and after the last there is none."""
    given = {"torque_n_m": "[0.0,2.0,-3.0]", "for_s": "[0.003,0.004,0.005]", "slew_n_m_s": "2000.0"}
    load = setups_of(*(f"drive.1.controller.{key}={value}" for key, value in given.items()))["load"]
    p, s = load.machine.law[0], new_law_state()[0]
    asked = []
    for _ in range(16):
        ask(p, s, 0.0, 0.0, 0.0, 1e9)
        asked.append(round(float(s["u"][1]), 9))
    assert asked == [0.0] * 3 + [2.0] * 4 + [0.0, -2.0, -3.0, -3.0, -3.0] + [0.0] * 4
    s = new_law_state()[0]
    for w in (1e3, -1e3, 0.0):  # no speed ends a row
        s["x"][0] = w
        ask(p, s, 0.0, 0.0, 0.0, 1e9)
    assert s["row"] == 0


def records(loads: str = "[]", **changed: float) -> tuple[Record, Record]:
    config = load_toml(CONFIGS / "plants" / "dyno-motor.toml", PlantConfig, [f"load={loads}"])
    p = build_params(config, WIRE)
    for field, value in changed.items():
        p[field] = value
    return p, new_state(p, 15)


def test_two_motors_at_rest_decay_as_one_shaft() -> None:
    """w(t) = w_0 e^{-(B_1 + B_2) t / (J_1 + J_2)} with both drives off."""
    (p, s), (q, r) = records(B_f=3e-3), records(B_f=1e-3, J=0.03)
    J = float(p["J"][0]) + 0.03
    couple(p, q)
    assert p["J"][0] == q["J"][0] == J
    s["x"][0, 0] = r["x"][0, 0] = 50.0
    advance_both(p[0], s[0], q[0], r[0], 400_000_000)
    assert math.isclose(s["x"][0, 0], 50.0 * math.exp(-4e-3 / J * 0.4), rel_tol=1e-12)
    assert r["x"][0, 0] == s["x"][0, 0] and s["t_ns"][0] == r["t_ns"][0] == 400_000_000


def running(p: Record, s: Record, torque: float) -> None:
    s["state"], s["q_ref"] = int(State.OPERATION_ENABLED), torque / p["drive_k_t"]


LOADS = """[{kind="cogging",torque_n_m=1.0,order=7},{kind="fan",k_n_m_s2=0.005},
{kind="step",torque_n_m=1.5,at_s=0.01,until_s=0.02}]"""


@pytest.mark.parametrize("loads", ["[]", LOADS.replace("\n", "")], ids=["bare", "loaded"])
@pytest.mark.parametrize("which", [0, 1])
def test_one_that_is_off_is_inertia_alone(which: int, loads: str) -> None:
    """The pair is the single motor of both inertias, whichever of them is driven and loaded."""
    pair = [records(loads if place == which else "[]", B_f=0.0) for place in (0, 1)]
    (p, s), (q, r) = pair
    alone_p, alone_s = records(loads, B_f=0.0)
    alone_p["J"] *= 2.0
    couple(p, q)
    running(*pair[which], 4.0)
    running(alone_p, alone_s, 4.0)
    advance_both(p[0], s[0], q[0], r[0], 30_000_000)
    advance(alone_p[0], alone_s[0], 30_000_000)
    driven = pair[which][1]
    assert np.allclose(driven["x"], alone_s["x"], rtol=1e-12, atol=1e-13)
    assert np.allclose(driven["series"][0, ANGLE, 0], alone_s["series"][0, ANGLE, 0], rtol=1e-12)
    assert driven["x"][0, 0] > 1.0


def test_equal_and_opposite_torques_hold_the_shaft() -> None:
    (p, s), (q, r) = records(), records()
    couple(p, q)
    running(p, s, 4.0)
    running(q, r, -4.0)
    advance_both(p[0], s[0], q[0], r[0], 50_000_000)
    assert abs(s["x"][0, 0]) < 1e-12 and math.isclose(s["x"][0, 1], -r["x"][0, 1], rel_tol=1e-12)
    assert s["x"][0, 1] > 1.0


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("friction.coulomb_n_m=0.1", "plant of load: friction: not on a shaft of two motors; remove it"),
        ("inverter.capacitance_f=1e-3", "plant of load: inverter.capacitance_f"),
        ('fault=[{kind="phase-loss",at_s=0.1}]', "plant of load: fault: phase-loss"),
        ('load=[{kind="brake",torque_n_m=1.0,at_s=0.0}]', "plant of load: a load that only holds"),
    ],
)
def test_what_only_one_motor_can_have(setting: str, said: str) -> None:
    more = ["inverter.rectifier_ohm=0.5"] if "capacitance" in setting else []
    plant = load_toml(CONFIGS / "plants" / "dyno-load.toml", PlantConfig, [setting, *more])
    with pytest.raises(PlantError, match=said):
        refuse_uncoupled({"load": plant})


def test_the_emulated_node_is_the_one_that_is_run() -> None:
    nodes = load_nodes(DYNO, ['bus.interface="virtual"', "drive.1.node_id=9"])
    assert nodes is not None
    with pytest.raises(
        ConfigError, match=r"node load: emulator.plant: node 6 is emulated, drive.node_id is 9"
    ):
        make_bench(DYNO, nodes, [])


def test_two_drives_answer_one_sync() -> None:
    class Deaf:
        sync_id = None

    with pytest.raises(PlantError, match="two drives on one shaft must answer the same SYNC"):
        Bench(Listened([]), [Deaf(), Deaf()])  # type: ignore[list-item]


class Listened:
    """A bus with frames that wait, as a script."""

    def __init__(self, frames: list[Frame]) -> None:
        self.frames, self.sent, self.closed = frames, 0, 0

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        self.sent += 1

    def receive(self, timeout_ns: int) -> Frame | None:
        return self.frames.pop(0) if self.frames else None

    def discard(self) -> int:
        count, self.frames = len(self.frames), []
        return count

    def close(self) -> None:
        self.closed += 1


def hub_of(*frames: tuple[int, int]) -> tuple[Hub, Listened]:
    link = Listened([Frame(can_id, b"", flags, False) for can_id, flags in frames])
    return Hub(link, [setup.binding for setup in setups_of().values()]), link


def test_a_guardian_s_link_sends_and_hears_nothing() -> None:
    """Whose frames nobody reads need no copy for each, which who sends them would pay for."""
    bus = BusSettings("hil-local", f"deaf-{os.getpid()}")
    other, link = open_link(bus), deaf(open_link(bus))
    other.send(0x181, bytes(8))
    link.send(0x201, b"\x06")
    heard = other.receive(1_000_000_000)
    assert heard is not None and (heard.can_id, heard.data) == (0x201, b"\x06")
    assert link.receive(50_000_000) is None
    link.close()
    other.close()


def test_each_client_gets_what_its_drive_sends() -> None:
    """In order, each once; what is nobody's and a foreign command go where they are judged, errors to all."""
    hub, link = hub_of(
        (0x186, 0), (0x185, 0), (0x123, 0), (0x206, 0), (0x40, ERR_FLAG), (0x705, 0), (0x86, 0)
    )
    motor, load = hub.ports
    seen = {port: [] for port in (motor, load)}
    for port in (motor, load):
        while (frame := port.receive(0)) is not None:
            seen[port].append(frame.can_id)
    assert seen[motor] == [0x185, 0x123, 0x40, 0x705] and seen[load] == [0x186, 0x206, 0x40, 0x86]
    load.close()
    assert link.closed == 0, "the bus is the first client's, too"
    motor.close()
    assert link.closed == 1


@pytest.mark.parametrize("fd", [False, True])
def test_on_sockets_the_kernel_sorts(fd: bool) -> None:
    """The same as by a hub: each node has a socket, on which it hears its own; none hears what it sent."""
    channel = f"sorted-{os.getpid()}-{fd}"
    bus = BusSettings("hil-local", channel, fd=True)
    links = links_of(lambda: open_link(bus), [setup.binding for setup in setups_of().values()])
    other = open_link(bus)
    sent = [(0x186, 0), (0x185, 0), (0x123, 0), (0x206, 0), (0x40, ERR_FLAG), (0x705, 0), (0x86, 0)]
    sent += [(0x186, EFF_FLAG), (0x186, RTR_FLAG)]
    assert isinstance(other, SocketLink)
    for can_id, flags in sent:
        other.send_raw(memoryview(pack_frame(can_id | flags, b"", fd)))
    links[1].send(0x206, b"")
    links[0].send(0x205, b"")
    seen = [[], []]
    for place, link in enumerate(links):
        while (frame := link.receive(50_000_000)) is not None:
            seen[place].append((frame.can_id, frame.flags))
    motor, load = seen
    assert motor == [sent[i] for i in (1, 2, 4, 5, 7, 8)] and load == [sent[i] for i in (0, 3, 4, 6)]
    for link in (*links, other):
        link.close()


def test_no_link_stays_open_when_one_can_not_be_opened() -> None:
    made: list[SocketLink] = []

    def opened() -> Any:
        if made:
            raise LinkError(19, "no such bus")
        made.append(open_link(BusSettings("hil-local", f"half-{os.getpid()}")))  # type: ignore[arg-type]
        return made[0]

    with pytest.raises(LinkError, match="no such bus"):
        links_of(opened, [setup.binding for setup in setups_of().values()])
    assert made[0].receiving.fileno() == -1


def test_a_flood_for_one_does_not_hold_the_other() -> None:
    hub, link = hub_of(*[(0x185, 0)] * (READ_MOST + 10))
    assert hub.ports[1].receive(0) is None and len(link.frames) == 10
    assert hub.ports[0].discard() == READ_MOST + 10 and hub.ports[0].receive(0) is None


def test_what_came_late_is_logged_before_the_next_sync() -> None:
    """Replay reads the frames in the log's order: after SYNC they would be the new tick's measurements."""
    did: list[str] = []

    class Noted:
        def __init__(self, name: str) -> None:
            self.name = name

        def __getattr__(self, what: str) -> Any:
            return lambda *_: did.append(f"{self.name} {what}")

    axes = [SimpleNamespace(client=Noted(name), tick=None) for name in ("motor", "load")]
    assert exchange(NodesLoop, SimpleNamespace(_axes=axes, _words=()), new_pace(), 2, 0)
    assert did == [
        "load follow", "load flush", "motor sync", "motor flush", "load receive", "load flush",
        "motor receive", "motor flush",
    ]  # fmt: skip


def test_what_a_node_hears_is_its_own() -> None:
    motor, load = (heard_ids(setup.binding) for setup in setups_of().values())
    assert motor == {0x185, 0x285, 0x205, 0x705, 0x85} and load == {0x186, 0x286, 0x206, 0x706, 0x86}


@pytest.fixture
def logged(tmp_path: Path) -> Path:
    """A file with the ticks of two nodes, which differ in w."""
    path = tmp_path / "two.mcap"
    header = {
        "metadata": {"kind": "run", "format": "2"},
        "attachments": {"a": "1", "a of load": "2", "b": "3"},
        "nodes": ["load"],
        "more": {"nodes": {"names": "motor,load"}, "run of load": {"kind": "own"}},
    }
    ticks = new_ticks(3)
    ticks["k"], ticks["gap"] = range(3), 1
    other = ticks.copy()
    other["w"] = 7.0
    with RunFile(path, header) as file:
        file.add_ticks(ticks)
        file.add_ticks(other, "load")
        file.finish({"ended": "a", "ticks": 3, "nodes": {"load": {"ended": "b"}}})
    return path


def test_one_file_is_read_node_by_node(logged: Path) -> None:
    first, load = (open_log(logged, node=node) for node in ("", "load"))
    assert first.damage is None and load.damage is None
    assert (first.ticks["w"] == 0.0).all() and (load.ticks["w"] == 7.0).all() and len(load.ticks) == 3
    assert (first.attachments["a"], load.attachments["a"], load.attachments["b"]) == ("1", "2", "3")
    assert (first.metadata["run"]["kind"], load.metadata["run"]["kind"]) == ("run", "own")
    assert (first.result["ended"], load.result["ended"], load.result["ticks"]) == ("a", "b", 3)
    assert first.nodes == load.nodes == ("motor", "load")


def test_the_check_judges_the_loop_of_both_as_one() -> None:
    """With the pole and window of dyno.toml its margins are the same; a commanded torque has no loop."""
    (speed, torque), (fac, follow) = (
        [filter_rows(one) for one in load_node_setups(path, Overrides()).values()]  # type: ignore[union-attr]
        for path in (DYNO, FAC)
    )
    assert fac == speed and fac[0].verdict == "pass" and "Ms 1.59" in fac[0].found
    assert torque == follow == []
