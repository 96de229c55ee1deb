"""A drive of quite another protocol, driven by a map alone; and every mistake of a map named at once."""

from __future__ import annotations

import dataclasses
import math
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.binding import bind
from drivers.bus import BusSettings, open_link
from drivers.client import DriveClient
from drivers.codec import Database
from drivers.errors import DatabaseError
from drivers.mapping import DriveMap, house_map, map_from_table
from drivers.states import of_statusword
from hil.signals import RxFlag, new_ticks
from tests.conftest import CONFIGS

# Big endian, extended ids, CAN FD command, rpm and mA, currents in a frame of their own, no SYNC, no E2E,
# no echo, an enable bit in place of a controlword.
OTHER_DBC = """VERSION ""

NS_ :

BS_:

BU_: Ecu Inverter

BO_ 2566852608 MotorSpeed: 8 Inverter
 SG_ Rpm : 7|16@0- (0.5,0) [-16000|16000] "rpm" Ecu
 SG_ Mode : 23|8@0+ (1,0) [0|255] "" Ecu
 SG_ Alive : 31|4@0+ (1,0) [0|15] "" Ecu

BO_ 2566852609 MotorCurrent: 8 Inverter
 SG_ Iq : 7|16@0- (10,0) [-327680|327670] "mA" Ecu
 SG_ Id : 23|16@0- (10,0) [-327680|327670] "mA" Ecu

BO_ 2566852610 Supply: 2 Inverter
 SG_ Udc : 7|16@0+ (0.1,0) [0|1000] "V" Ecu

BO_ 2566852864 Demand: 12 Ecu
 SG_ Uq : 7|24@0- (0.0001,0) [-400|400] "V" Inverter
 SG_ Ud : 31|24@0- (0.0001,0) [-400|400] "V" Inverter
 SG_ On : 55|1@0+ (1,0) [0|1] "" Inverter
 SG_ ClearFault : 54|1@0+ (1,0) [0|1] "" Inverter
 SG_ Key : 63|8@0+ (1,0) [0|255] "" Inverter
 SG_ Alive : 71|4@0+ (1,0) [0|15] "" Inverter

BO_ 1000 Chatter: 8 Inverter
 SG_ Which M : 0|8@1+ (1,0) [0|255] "" Ecu
 SG_ A m0 : 8|8@1+ (1,0) [0|255] "" Ecu
 SG_ B m1M : 8|8@1+ (1,0) [0|255] "" Ecu
 SG_ C m2 : 16|8@1+ (1,0) [0|255] "" Ecu

SG_MUL_VAL_ 1000 A Which 0-0;
SG_MUL_VAL_ 1000 B Which 1-1;
SG_MUL_VAL_ 1000 C B 2-2;

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 2566852608 5;
"""

OTHER_TABLE = """
speed = "MotorSpeed.Rpm"
i_q = "MotorCurrent.Iq"
i_d = "MotorCurrent.Id"
state = "MotorSpeed.Mode"
v_dc = "Supply.Udc"
u_q = "Demand.Uq"
u_d = "Demand.Ud"
enable = "Demand.On"
reset = "Demand.ClearFault"
counters = ["MotorSpeed.Alive", "Demand.Alive"]
[states]
0 = "off"
1 = "operation enabled"
9 = "fault"
[constants]
"Demand.Key" = 90
"""


@pytest.fixture
def database(tmp_path: Path) -> Database:
    path = tmp_path / "other.dbc"
    path.write_text(OTHER_DBC)
    return Database(path)


@pytest.fixture
def other() -> DriveMap:
    return map_from_table(tomllib.loads(OTHER_TABLE), "demo.toml: drive.signals")


class Inverter:
    """The far end, speaking its own protocol by python alone."""

    def __init__(self, database: Database, drive: DriveMap, channel: str) -> None:
        settings = BusSettings("hil-local", channel, fd=True)
        self.link, link = open_link(settings), open_link(settings)
        self.client = DriveClient(link, database, drive_map=drive)
        self.tick: Any = new_ticks()[0]
        self._alive = 0

    def speed(self, rpm: float, mode: int) -> None:
        self._alive = (self._alive + 1) % 16
        raw = round(rpm / 0.5)
        data = raw.to_bytes(2, "big", signed=True) + bytes((mode, self._alive << 4, 0, 0, 0, 0))
        self.link.send(0x98FF1000, data)

    def current(self, i_q: int, i_d: int) -> None:
        data = b"".join(value.to_bytes(2, "big", signed=True) for value in (i_q, i_d)) + bytes(4)
        self.link.send(0x98FF1001, data)

    def receive(self, seconds: float = 0.05) -> int:
        self.tick["rx_flags"] = 0
        self.client.receive(self.tick, time.monotonic_ns() + round(seconds * 1e9))
        return int(self.tick["rx_flags"])

    def command(self, controlword: int, u_q: float = 0.0, counter: int = 0) -> bytes:
        self.tick["controlword"], self.tick["u_q"], self.tick["counter"] = controlword, u_q, counter
        self.client.send(self.tick)
        frame = self.link.receive(10**9)
        assert frame is not None and frame.can_id == 0x18FF1100 and frame.fd
        assert self.link.receive(0) is None
        return frame.data


@pytest.fixture
def inverter(database: Database, other: DriveMap, channel: str) -> Iterator[Inverter]:
    made = Inverter(database, other, channel)
    yield made
    made.client.close()
    made.link.close()


def test_feedback_is_fresh_when_both_frames_came(inverter: Inverter) -> None:
    inverter.speed(-600.0, 1)
    assert inverter.receive() == 0
    inverter.current(150, -20)
    assert inverter.receive(2.0) == RxFlag.FRESH
    tick = inverter.tick
    assert tick["w"] == pytest.approx(-600 * 2 * math.pi / 60)
    assert (tick["i_q"], tick["i_d"]) == pytest.approx((1.5, -0.2))
    inverter.speed(0.0, 1)
    inverter.speed(300.0, 1)
    assert inverter.receive() == 0, "two of one kind are not a pair"


def test_slow_values_come_when_they_come(inverter: Inverter) -> None:
    inverter.link.send(0x98FF1002, (5600).to_bytes(2, "big"))
    assert inverter.receive() == RxFlag.STATUS
    assert inverter.tick["v_dc"] == pytest.approx(560.0)


def test_commands_by_hand(inverter: Inverter) -> None:
    # -1.5 V = -15000 = FFC568; On 0x80; Key 90 = 5A; Alive 3 in the top nibble
    assert inverter.command(0x0F, -1.5, counter=19).hex(" ") == "ff c5 68 00 00 00 80 5a 30 00 00 00"
    assert inverter.command(0x80, counter=4).hex(" ") == "00 00 00 00 00 00 40 5a 40 00 00 00"
    assert inverter.command(0x06, counter=5)[6] == 0


def test_an_on_off_drive_walks_through_cia_402(inverter: Inverter) -> None:
    def state(mode: int) -> int:
        inverter.speed(0.0, mode)
        inverter.current(0, 0)
        assert inverter.receive(2.0) & RxFlag.FRESH
        return int(inverter.tick["drive_state"])

    walk = [state(0)]
    for controlword, mode in [(0x06, 0), (0x07, 0), (0x0F, 0), (0x0F, 1), (0x02, 1), (0x02, 0), (0x00, 9)]:
        inverter.command(controlword)
        walk.append(state(mode))
    assert walk == [1, 2, 3, 3, 4, 4, 1, 7]
    assert state(77) == 0, "an unknown value is not ready"


def test_without_an_echo_the_newest_command_counts(inverter: Inverter) -> None:
    inverter.command(0x0F, counter=201)
    inverter.speed(0.0, 1)
    inverter.current(0, 0)
    assert inverter.receive(2.0) & RxFlag.FRESH
    assert inverter.tick["echo"] == 201


def test_no_sync_is_sent_and_stopping_switches_off(inverter: Inverter) -> None:
    inverter.client.sync(inverter.tick)
    assert inverter.link.receive(20_000_000) is None
    inverter.command(0x0F, 100.0)
    inverter.client.stop()
    stops = []
    while (frame := inverter.link.receive(20_000_000)) is not None:
        stops.append(frame.data)
    assert [data[8] >> 4 for data in stops] == [1, 2, 3, 4, 5]
    assert all(data[:7] == bytes(7) for data in stops)


def test_heard_by_any_frame_of_its_own(inverter: Inverter) -> None:
    inverter.current(0, 0)
    assert inverter.client.wait_for_drive(1.0)


def test_the_binding_tells_steps_in_si(database: Database, other: DriveMap) -> None:
    binding = bind(other, database)
    speed, i_q, u_q = (binding.signal(part) for part in ("speed", "i_q", "u_q"))
    assert speed and i_q and u_q
    assert (speed.scale, i_q.scale, u_q.scale) == pytest.approx((0.5 * math.pi / 30, 0.01, 1e-4))
    assert (speed.minimum, speed.maximum) == pytest.approx((-16000 * math.pi / 30, 16000 * math.pi / 30))
    assert u_q.top == 400.0 and binding.counter_modulus == 16 and binding.signal("echo") is None


@pytest.mark.parametrize("name", ["hil_pmsm.dbc", "hil_pmsm_fd.dbc"])
@pytest.mark.parametrize("load", [False, True])
def test_the_house_protocol_binds(name: str, load: bool) -> None:
    database = Database(CONFIGS / "drives" / name)
    binding = bind(house_map(database), database, load=load, period_ms=1.0)
    assert binding.command.message.name == "COMMAND" and binding.sync
    assert binding.counter_modulus == binding.command.message.counter_modulus
    assert (binding.signal("load_torque") is not None) == load


CHANGES: list[tuple[dict[str, Any], str]] = [
    ({"speed": "MotorSpeeds.Rpm"}, "speed: has no message MotorSpeeds; it has Chatter, Demand"),
    ({"speed": "MotorSpeed.Spin"}, "speed: message MotorSpeed has no signal Spin; it has Rpm, Mode"),
    ({"speed": "MotorSpeedRpm"}, 'speed = "MotorSpeedRpm": write it as "MESSAGE.Signal"'),
    ({"speed": ""}, "speed: missing"),
    ({"speed": "MotorCurrent.Iq"}, "speed: MotorCurrent.Iq has the unit 'mA'; give it one of rad/s, rpm"),
    ({"i_q": "Supply.Udc"}, "it must reach below and above 0"),
    ({"v_dc": "MotorSpeed.Mode"}, "v_dc: MotorSpeed.Mode has the unit ''"),
    ({"limited": "Chatter.C"}, "multiplexed by more than one value"),
    ({"enable": ""}, "controlword or enable: one of them must be named"),
    ({"echo": "MotorSpeed.Mode"}, "echo: MotorSpeed.Mode has 8 bits, Demand.Alive 4"),
    ({"echo": "MotorSpeed.Mode", "counters": ()}, "echo: Demand has no counter to echo"),
    ({"counters": ("Demand.Beat",)}, "counters: message Demand has no signal Beat"),
    ({"counters": ("Demand.Uq",)}, "counters: Demand.Uq must be a plain unsigned number"),
    ({"counters": ("Elsewhere.Alive",)}, "counters: Elsewhere is no message of this map"),
    ({"constants": {"Demand.Lock": 1.0}}, "constants: message Demand has no signal Lock"),
    ({"constants": {"Supply.Udc": 1.0}}, "Supply is no message of the command"),
    ({"constants": {"Demand.Key": 300.0}}, "Demand.Key: 300 can't be sent"),
    ({"states": {0: "asleep"}}, 'states: 0 = "asleep"; known are not ready'),
    ({"states": {0: "off"}}, 'no value is "operation enabled"'),
    ({"states": "words"}, 'states = "words"'),
    ({"sync": "Tick"}, "sync: has no message Tick"),
    ({"limited": "Demand.On"}, "Demand is both received and sent"),
]


@pytest.mark.parametrize(("change", "text"), CHANGES, ids=[text[:40] for _, text in CHANGES])
def test_a_mistake_is_named(database: Database, other: DriveMap, change: dict[str, Any], text: str) -> None:
    with pytest.raises(DatabaseError) as caught:
        bind(dataclasses.replace(other, **change), database)
    refusal = str(caught.value)
    assert text in refusal and str(database.path) in refusal and len(refusal.splitlines()) == 1


def test_all_mistakes_come_at_once(database: Database, other: DriveMap) -> None:
    wrong = dataclasses.replace(other, speed="A.B", i_q="MotorCurrent.Iz", u_q="Demand.Ux", enable="")
    with pytest.raises(DatabaseError) as caught:
        bind(wrong, database)
    assert all(name in str(caught.value) for name in ("no message A", "Iz", "Ux", "enable"))


def test_a_drive_that_is_too_slow_is_refused(database: Database, other: DriveMap) -> None:
    bind(other, database, period_ms=5.0)
    said = "comes every 5 ms by the DBC, the loop counts on one every 1 ms; write feedback.period_ms = 5"
    with pytest.raises(DatabaseError, match=said):
        bind(other, database, period_ms=1.0)


def test_a_range_without_zero_is_refused(tmp_path: Path, other: DriveMap) -> None:
    path = tmp_path / "no_zero.dbc"
    path.write_text(
        OTHER_DBC.replace("SG_ Ud : 31|24@0- (0.0001,0) [-400|400]", "SG_ Ud : 31|24@0- (0.0001,0) [1|400]")
    )
    with pytest.raises(DatabaseError, match=r"Demand\.Ud: 0 can't be sent"):
        bind(other, Database(path))


def test_protection_needs_its_counter() -> None:
    database = Database(CONFIGS / "drives/hil_pmsm.dbc")
    house = house_map(database)
    with pytest.raises(DatabaseError, match="counters: FEEDBACK has E2E profile 2; name its counter"):
        bind(dataclasses.replace(house, counters=("COMMAND.Counter",)), database)
    with pytest.raises(DatabaseError, match="profile 2 has its counter in the 4 bits from bit 8"):
        bind(dataclasses.replace(house, counters=("FEEDBACK.Echo", *house.counters[1:])), database)


def test_a_table_names_all_that_is_wrong() -> None:
    table = {
        "speed": 3,
        "colour": "red",
        "counters": "A.B",
        "states": {"x": "off"},
        "constants": {"A.B": "c"},
    }
    with pytest.raises(DatabaseError) as caught:
        map_from_table(table, "demo.toml: drive.signals")
    text = str(caught.value)
    assert text.startswith("demo.toml: drive.signals: ")
    for part in (
        "colour: unknown",
        "counters:",
        "states:",
        "constants:",
        "speed:",
        "i_q: missing",
        "u_q: missing",
    ):
        assert part in text


def test_statuswords() -> None:
    words = {0x0000: 0, 0x0240: 1, 0x0231: 2, 0x0233: 3, 0x0637: 4, 0x0617: 5, 0x001F: 6, 0x0018: 7}
    assert {word: of_statusword(word) for word in words} == words
