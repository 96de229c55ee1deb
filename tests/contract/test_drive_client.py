"""The drive client on a real bus: what it fills in, what it refuses, what it sends, how it stops."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers import frames
from drivers.binding import bind
from drivers.bus import BusSettings, Frame, Link, open_link
from drivers.client import STOP_REPEATS, DriveClient
from drivers.codec import Database
from drivers.errors import DatabaseError, EncodeError, LinkDown, LinkError, QueueFull
from drivers.local import EFF_FLAG, ERR_FLAG, RTR_FLAG
from drivers.mapping import DriveMap, house_map
from drivers.wire import FRAME
from hil.signals import RxFlag, new_ticks
from tests.conftest import CONFIGS

HOUSE = CONFIGS / "drives/hil_pmsm.dbc"
FD = CONFIGS / "drives/hil_pmsm_fd.dbc"
CURRENT = CONFIGS / "drives/hil_current.dbc"


class Bench:
    """A client and, on the other end of the bus, whoever speaks to it."""

    def __init__(self, kind: str, channel: str, path: Path, **options: Any) -> None:
        settings = BusSettings(kind, channel, fd=True)
        self.database = Database(path)
        self.peer, link = open_link(settings), open_link(settings)
        self.client = DriveClient(link, self.database, **options)
        self.ticks = new_ticks()
        self.tick: Any = self.ticks[0]

    def feed(self, name: str, **values: float) -> None:
        message = self.database.message(name)
        self.peer.send(message.send_id, message.encode(values), message.fd)

    def receive(self, seconds: float = 0.0) -> int:
        """Flags of one receive; waits for feedback when ``seconds`` is given."""
        self.tick["rx_flags"] = 0
        self.client.receive(self.tick, time.monotonic_ns() + round(seconds * 1e9) if seconds else 0)
        return int(self.tick["rx_flags"])

    def heard(self) -> list[Frame]:
        out = []
        while (frame := self.peer.receive(20_000_000)) is not None:
            out.append(frame)
        return out

    def close(self) -> None:
        self.client.close()
        self.peer.close()


@pytest.fixture(params=["hil-local", "virtual"])
def bench(request: pytest.FixtureRequest, channel: str) -> Iterator[Bench]:
    made = Bench(request.param, channel, HOUSE)
    yield made
    made.close()


def test_flags_are_hils_own() -> None:
    own = {"GUARDIAN", "GUARDIAN_LOST"}  # set by hil.runtime.guardian, never by a bus
    theirs = {name: flag.value for name, flag in RxFlag.__members__.items() if name not in own}
    assert theirs == {name: getattr(frames, name) for name in theirs}


def test_feedback_fills_the_tick(bench: Bench) -> None:
    bench.feed("FEEDBACK", Counter=1, Echo=9, Speed=-12.5, CurrentQ=1.234, CurrentD=-0.5, State=4, Limited=1)
    assert bench.receive(2.0) == RxFlag.FRESH
    tick = bench.tick
    assert (tick["w"], tick["i_q"], tick["i_d"]) == (-1250 * 0.01, 1234 * 0.001, -50 * 0.01)
    assert (tick["echo"], tick["drive_state"], tick["limited"]) == (9, 4, 1)


def test_what_is_no_record_of_its_own_is_refused(bench: Bench) -> None:
    for tick in ({"w": 0.0}, new_ticks().repeat(3)[1]):
        with pytest.raises(TypeError, match="no record of a structured array of one"):
            bench.client.receive(tick, 0)


def test_only_named_fields_change(bench: Bench) -> None:
    before = bench.ticks.tobytes()
    bench.feed("FEEDBACK", Counter=1, Speed=2.0)
    bench.receive(2.0)
    for name in ("w", "rx_flags"):
        bench.tick[name] = 0
    after = bench.ticks.copy()
    assert after.tobytes() == before


def test_status_fills_slow_values_and_feedback_ends_the_wait(bench: Bench) -> None:
    bench.feed(
        "STATUS", Counter=3, DcLinkVoltage=560.0, TemperatureMotor=25, TemperatureInverter=-7, ErrorCode=5
    )
    bench.feed("FEEDBACK", Counter=1)
    assert bench.receive(2.0) == RxFlag.FRESH | RxFlag.STATUS
    tick = bench.tick
    assert tick["v_dc"] == pytest.approx(560.0)
    assert (tick["temperature_motor"], tick["temperature_inverter"], tick["drive_error"]) == (25, -7, 5)


def test_truth_is_taken(bench: Bench) -> None:
    bench.feed("TRUTH", LoadTorqueTrue=5.5, SpeedTrue=1.0)
    assert bench.receive() == 0
    assert bench.tick["T_L_true"] == 5.5


def test_counters(bench: Bench) -> None:
    def flags(counter: int, speed: float) -> int:
        bench.feed("FEEDBACK", Counter=counter, Speed=speed)
        return bench.receive(0.05)

    assert flags(15, 1.0) == RxFlag.FRESH
    assert flags(0, 2.0) == RxFlag.FRESH, "15 -> 0 is no jump"
    assert flags(0, 9.0) == RxFlag.COUNTER_REPEATED
    assert bench.tick["w"] == 2.0, "a repeated frame is not applied"
    assert flags(3, 3.0) == RxFlag.FRESH | RxFlag.COUNTER_JUMP
    assert bench.tick["w"] == 3.0


@pytest.mark.parametrize("name", ["FEEDBACK", "STATUS"])
def test_a_damaged_frame_changes_nothing(bench: Bench, name: str) -> None:
    message = bench.database.message(name)
    good = message.encode({"Counter": 1, next(iter(list(message.signals)[3:])): 7.0})
    before = bench.ticks.tobytes()
    for position in range(8):
        data = bytearray(good)
        data[position] ^= 0x10
        bench.peer.send(message.can_id, bytes(data))
        assert bench.receive() == RxFlag.CRC_ERROR
    for data in (b"", good[:7]):
        bench.peer.send(message.can_id, bytes(data))
        assert bench.receive() == RxFlag.LENGTH_ERROR
    bench.peer.send(message.can_id, good + bytes(4), True)
    assert bench.receive() == RxFlag.LENGTH_ERROR
    bench.tick["rx_flags"] = 0
    assert bench.ticks.tobytes() == before


def test_emergency(bench: Bench) -> None:
    bench.feed("EMCY", ErrorCode=0x2310, ErrorRegister=1)
    assert bench.receive() == RxFlag.EMERGENCY and bench.tick["drive_error"] == 0x2310
    bench.feed("EMCY", ErrorCode=0)
    assert bench.receive() == 0 and bench.tick["drive_error"] == 0, "error reset"
    bench.peer.send(0x81, b"\x01")
    assert bench.receive() == RxFlag.LENGTH_ERROR and bench.tick["drive_error"] == 0


def test_frames_of_others_are_no_ones_business(bench: Bench) -> None:
    for can_id in (0x182, 0x7DF, 0x181 | EFF_FLAG, 0x201 | EFF_FLAG, 0x701):
        bench.peer.send(can_id, bytes(8))
    assert bench.receive() == 0


@pytest.mark.parametrize("can_id", [0x201, 0x080])
def test_another_master_is_seen(bench: Bench, can_id: int) -> None:
    bench.peer.send(can_id, b"\x01")
    assert bench.receive() == RxFlag.FOREIGN_COMMAND


class ScriptedLink:
    """An unreachable fault: a bus that fails, or hands out frames that no healthy bus has."""

    def __init__(self) -> None:
        self.incoming: list[Frame | OSError] = []
        self.outgoing: list[OSError] = []
        self.sent: list[tuple[int, bytes]] = []

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        if self.outgoing:
            raise self.outgoing.pop(0)
        self.sent.append((can_id, data))

    def receive(self, timeout_ns: int) -> Frame | None:
        if not self.incoming:
            return None
        item = self.incoming.pop(0)
        if isinstance(item, OSError):
            raise item
        return item

    def discard(self) -> int:
        return 0

    def close(self) -> None:
        pass


def scripted() -> tuple[ScriptedLink, DriveClient, Any]:
    link = ScriptedLink()
    checked: Link = link
    return link, DriveClient(checked, Database(HOUSE)), new_ticks()[0]


def test_error_frames_are_flagged_and_remote_frames_are_not_applied() -> None:
    link, client, tick = scripted()
    link.incoming = [Frame(0x181, bytes(8), RTR_FLAG, False), Frame(4, bytes(8), ERR_FLAG, False)]
    client.receive(tick, 0)
    assert tick["rx_flags"] == RxFlag.ERROR_FRAME


@pytest.mark.parametrize("error_class", [0x40, 0x100, 0x44])
def test_bus_off_and_a_restart_after_it_are_a_bus_that_is_down_for_good(error_class: int) -> None:
    link, client, tick = scripted()
    link.incoming = [Frame(error_class, bytes(8), ERR_FLAG, False)]
    client.receive(tick, 0)
    assert tick["rx_flags"] == RxFlag.ERROR_FRAME | RxFlag.BUS_DOWN
    with pytest.raises(LinkDown):
        client.send(tick)


def test_after_an_outage_nothing_is_ever_sent() -> None:
    link, client, tick = scripted()
    link.incoming = [LinkDown(100, "down")]
    client.receive(tick, 0)
    assert tick["rx_flags"] == RxFlag.BUS_DOWN
    for action in (client.send, client.sync):
        with pytest.raises(LinkDown):
            action(tick)
    client.stop()
    assert link.sent == []
    tick["rx_flags"] = 0
    client.receive(tick, 0)
    assert tick["rx_flags"] == RxFlag.BUS_DOWN, "it stays down until the client is closed"


def test_an_outage_seen_by_sending_counts_too() -> None:
    link, client, tick = scripted()
    link.outgoing = [LinkDown(100, "down")]
    with pytest.raises(LinkDown):
        client.send(tick)
    client.stop()
    assert link.sent == []


def test_a_full_queue_is_flagged_in_the_next_tick() -> None:
    link, client, tick = scripted()
    link.outgoing = [QueueFull(105, "full")]
    with pytest.raises(QueueFull):
        client.send(tick)
    client.receive(tick, 0)
    assert tick["rx_flags"] == RxFlag.SEND_FAILED
    tick["rx_flags"] = 0
    client.receive(tick, 0)
    assert tick["rx_flags"] == 0


def test_stop_goes_on_through_a_full_queue() -> None:
    link, client, _ = scripted()
    link.outgoing = [QueueFull(105, "full"), QueueFull(105, "full")]
    client.stop()
    assert len([can_id for can_id, _ in link.sent if can_id == 0x201]) == STOP_REPEATS - 2


def test_a_flood_does_not_hold_the_tick() -> None:
    link, client, tick = scripted()
    link.incoming = [Frame(0x7DF, bytes(8), 0, False)] * 10_000
    client.receive(tick, 0)
    drained = 10_000 - len(link.incoming)
    assert 0 < drained <= 1000
    client.receive(tick, 1)  # a deadline long past
    assert 10_000 - len(link.incoming) == 2 * drained


def test_late_feedback_is_not_fresh(bench: Bench) -> None:
    bench.feed("FEEDBACK", Counter=1, Speed=5.0)
    bench.client.sync(bench.tick)
    assert bench.tick["rx_flags"] == 0 and bench.tick["w"] == 0.0
    bench.feed("FEEDBACK", Counter=2, Speed=6.0)
    assert bench.receive(2.0) == RxFlag.FRESH, "the late frame's counter counted"
    assert bench.tick["w"] == 6.0


@contextmanager
def answering(bench: Bench, **values: float) -> Iterator[list[int]]:
    """The other end answers each SYNC with feedback; yields the counts of the SYNCs that it saw."""
    counts: list[int] = []
    over = threading.Event()

    def answer() -> None:
        while not over.is_set():
            frame = bench.peer.receive(10_000_000)
            if frame is not None and frame.can_id == 0x80:
                counts.append(frame.data[0])
                bench.feed("FEEDBACK", Counter=len(counts) % 16, **values)

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield counts
    finally:
        over.set()
        thread.join()


def test_an_exchange_is_sync_and_feedback(bench: Bench) -> None:
    bench.client.prepare(bench.tick)
    with answering(bench, Speed=3.0) as counts:
        for _ in range(242):
            bench.tick["rx_flags"] = 0
            bench.client.exchange(bench.tick, time.monotonic_ns() + 2 * 10**9)
            assert bench.tick["rx_flags"] == RxFlag.FRESH
    assert counts == [*range(1, 241), 1, 2] and bench.tick["w"] == 3.0


def test_an_exchange_takes_what_is_late_first_and_may_hear_nothing(bench: Bench) -> None:
    bench.client.prepare(bench.tick)
    bench.feed("FEEDBACK", Counter=0, Speed=5.0)
    bench.tick["rx_flags"] = 0
    bench.client.exchange(bench.tick, 1)
    assert (bench.tick["rx_flags"], bench.tick["w"]) == (0, 0.0), "the late feedback is not applied"
    assert [frame.data for frame in bench.heard()] == [b"\x01"]
    bench.client.exchange(bench.tick, 1)
    assert [frame.data for frame in bench.heard()] == [b"\x02"]
    with answering(bench, Speed=6.0):
        bench.client.exchange(bench.tick, time.monotonic_ns() + 2 * 10**9)
    assert (bench.tick["rx_flags"], bench.tick["w"]) == (RxFlag.FRESH, 6.0)


def test_an_exchange_on_a_closed_bus_says_so(bench: Bench) -> None:
    bench.client.prepare(bench.tick)
    bench.client.close()
    with pytest.raises(LinkError):
        bench.client.exchange(bench.tick, 1)


def test_sync_counts_from_1_to_240(bench: Bench) -> None:
    got = []
    for _ in range(242):
        bench.client.sync(bench.tick)
        frame = bench.peer.receive(10**9)
        assert frame is not None and frame.can_id == 0x80
        got.append(frame.data[0])
    assert got == [*range(1, 241), 1, 2]


@pytest.mark.parametrize("kind", ["hil-local", "virtual"])
def test_a_request_of_one_byte_is_no_counter(kind: str, channel: str) -> None:
    class Asking(DriveClient):
        def request(self) -> bytes:
            return b"\x52"

    bench = Bench(kind, channel, HOUSE)
    client = Asking(open_link(BusSettings(kind, channel, fd=True)), bench.database)
    for _ in range(2):
        client.sync(bench.tick)
    asked = [frame.data for frame in bench.heard() if frame.can_id == 0x080]
    client.close()
    bench.close()
    assert asked == [b"\x52"] * 2


def test_the_command_is_the_ticks(bench: Bench) -> None:
    tick = bench.tick
    tick["counter"], tick["controlword"], tick["u_q"], tick["u_d"], tick["T_L"] = 7, 15, -3.27, 1.5, 9.0
    bench.client.send(tick)
    (frame,) = bench.heard()
    assert frame.can_id == 0x201
    values = bench.database.message("COMMAND").decode(frame.data)
    assert {
        k: values[k] for k in ("Counter", "Mode", "Controlword", "VoltageQ", "VoltageD")
    } == pytest.approx({"Counter": 7, "Mode": 0, "Controlword": 15, "VoltageQ": -3.27, "VoltageD": 1.5})


@pytest.mark.parametrize("kind", ["hil-local", "virtual"])
def test_a_drive_that_does_not_say_its_state_is_where_the_command_leads(kind: str, channel: str) -> None:
    house = house_map(Database(CURRENT))
    silent = replace(house, state="", u_q="", u_d="", i_q_ref="COMMAND.CurrentQ", i_d_ref="COMMAND.CurrentD")
    bench = Bench(kind, channel, CURRENT, drive_map=silent)
    bench.client.prepare(bench.tick)
    states = [int(bench.tick["drive_state"])]
    for controlword in (0x06, 0x07, 0x0F, 0x00, 0x80):
        bench.tick["controlword"] = controlword
        bench.client.send(bench.tick)
        states.append(int(bench.tick["drive_state"]))
    bench.close()
    assert states == [1, 2, 3, 4, 1, 1]


@pytest.mark.parametrize("value", [math.nan, math.inf, 400.0])
def test_what_cannot_be_encoded_is_not_sent(channel: str, value: float) -> None:
    bench = Bench("hil-local", channel, HOUSE, load=True)
    bench.tick["u_d"] = value
    with pytest.raises(EncodeError, match="VoltageD"):
        bench.client.send(bench.tick)
    assert bench.heard() == [], "not even the load command that goes first"
    bench.close()


def test_the_load_command_goes_first(channel: str) -> None:
    bench = Bench("hil-local", channel, HOUSE, load=True)
    bench.tick["counter"], bench.tick["T_L"] = 3, -2.5
    bench.client.send(bench.tick)
    load, command = bench.heard()
    assert (load.can_id, command.can_id) == (0x301, 0x201)
    values = bench.database.message("LOAD_COMMAND").decode(load.data)
    assert (values["Counter"], values["Enable"], values["LoadTorque"]) == (3, 1, -2.5)
    bench.close()


def test_stopping_sends_zero_and_disable_with_advancing_counters(bench: Bench) -> None:
    bench.tick["counter"], bench.tick["controlword"], bench.tick["u_q"] = 14, 15, 100.0
    bench.client.send(bench.tick)
    bench.heard()
    bench.client.stop()
    decode = bench.database.message("COMMAND").decode
    stops = [decode(frame.data) for frame in bench.heard() if frame.can_id == 0x201]
    assert [values["Counter"] for values in stops] == [15, 0, 1, 2, 3]
    assert all((v["Controlword"], v["VoltageQ"], v["VoltageD"]) == (0, 0, 0) for v in stops)


def test_stopping_a_closed_client_does_not_raise(bench: Bench) -> None:
    bench.client.close()
    bench.client.stop()


def test_waiting_for_the_drive_sends_nothing(bench: Bench) -> None:
    bench.peer.send(0x7DF, b"")
    assert not bench.client.wait_for_drive(0.05)
    bench.peer.send(0x701, b"\x05")
    assert bench.client.wait_for_drive(2.0)
    bench.feed("FEEDBACK", Counter=0)
    assert bench.client.wait_for_drive(2.0)
    assert bench.heard() == []


def test_listening_counts(bench: Bench) -> None:
    for _ in range(3):
        bench.peer.send(0x111, b"")
    assert bench.client.listen(0.1) == {0x111: 3}


def test_frames_are_shown_both_ways(channel: str) -> None:
    seen: list[tuple[int, ...]] = []
    bench = Bench(
        "hil-local",
        channel,
        HOUSE,
        on_frames=lambda records: seen.extend(
            (frame["received"], frame["t_ns"], frame["can_id"], frame["size"])
            for frame in np.frombuffer(records, FRAME)
        ),
        now=lambda: 42,
    )
    bench.feed("FEEDBACK", Counter=0)
    bench.client.sync(bench.tick)
    bench.client.send(bench.tick)
    bench.client.flush()
    assert seen == [(True, 42, 0x181, 8), (False, 42, 0x80, 1), (False, 42, 0x201, 8)]
    bench.close()


def test_fd_drive(channel: str) -> None:
    bench = Bench("hil-local", channel, FD, load=True)
    bench.feed("FEEDBACK", Counter=255, Echo=250, Speed=1e-6, State=3, DcLinkVoltage=48.0, ErrorCode=7)
    assert bench.receive(2.0) & RxFlag.FRESH
    assert (bench.tick["echo"], bench.tick["drive_state"], bench.tick["drive_error"]) == (250, 3, 7)
    assert bench.tick["w"] == pytest.approx(1e-6) and bench.tick["v_dc"] == pytest.approx(48.0)
    bench.feed("FEEDBACK", Counter=0)
    assert bench.receive(2.0) & (RxFlag.FRESH | RxFlag.COUNTER_JUMP) == RxFlag.FRESH
    bench.tick["counter"], bench.tick["T_L"], bench.tick["u_q"] = 200, 1.25, -1e-6
    bench.client.send(bench.tick)
    (frame,) = bench.heard()
    values = bench.database.message("COMMAND").decode(frame.data)
    assert len(frame.data) == 64 and frame.fd
    assert (values["Counter"], values["LoadEnable"]) == (200, 1)
    assert (values["LoadTorque"], values["VoltageQ"]) == pytest.approx((1.25, -1e-6))
    bench.close()


NMT = '\nBO_ 0 NMT: 2 Controller\n SG_ Command : 0|8@1+ (1,0) [0|255] "" Drive\n'


def with_nmt(path: Path, node_id: int, more: str = NMT) -> tuple[Database, DriveMap]:
    """The house protocol of a node that NMT starts and stops."""
    database = Database(path, node_id, text=HOUSE.read_text(encoding="utf-8") + more)
    return database, replace(house_map(database), nmt="NMT")


@pytest.mark.parametrize("node_id", [1, 5])
def test_nmt_starts_the_node_and_every_stop_leaves_operation(channel: str, node_id: int) -> None:
    """CiA 301: command and node number; nothing before start, 80h last of all in a stop."""
    database, drive_map = with_nmt(HOUSE, node_id)
    peer = open_link(BusSettings("hil-local", channel))
    client = DriveClient(open_link(BusSettings("hil-local", channel)), database, drive_map=drive_map)
    try:
        assert peer.receive(20_000_000) is None
        client.start()
        client.stop()
        sent = [(frame.can_id, frame.data) for frame in iter(lambda: peer.receive(20_000_000), None)]
    finally:
        client.close()
        peer.close()
    assert sent[0] == (0x000, bytes((0x01, node_id))) and sent[-1] == (0x000, bytes((0x80, node_id)))
    assert [data for can_id, data in sent if can_id == 0] == [sent[0][1], sent[-1][1]]
    assert 0x200 + node_id in {can_id for can_id, _ in sent}


def test_another_process_stops_the_node_too(channel: str) -> None:
    """The guardian stops with a client of its own, which has started nothing."""
    database, drive_map = with_nmt(HOUSE, 5)
    peer = open_link(BusSettings("hil-local", channel))
    client = DriveClient(open_link(BusSettings("hil-local", channel)), database, drive_map=drive_map)
    client.stop_from(3)
    sent = [(frame.can_id, frame.data) for frame in iter(lambda: peer.receive(20_000_000), None)]
    client.close()
    peer.close()
    assert [one for one in sent if one[0] == 0] == [sent[-1]] == [(0x000, b"\x80\x05")]


@pytest.mark.parametrize("more", [NMT.replace("2 Contr", "3 Contr"), NMT.replace("BO_ 0", "BO_ 1")])
def test_an_nmt_that_is_none(more: str) -> None:
    database, drive_map = with_nmt(HOUSE, 1, more)
    with pytest.raises(DatabaseError, match=r"nmt: NMT is not CANopen's: identifier 0x000, 2 bytes"):
        bind(drive_map, database)


def test_a_bus_that_is_down_takes_no_nmt_and_no_exception_comes(channel: str) -> None:
    database, drive_map = with_nmt(HOUSE, 5)
    client = DriveClient(open_link(BusSettings("hil-local", channel)), database, drive_map=drive_map)
    client.close()
    client.stop()
    client.leave()
    with pytest.raises(LinkError):
        client.start()
