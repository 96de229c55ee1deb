"""Every bit of a command has one owner, zero means zero on the wire, and stopping can't fail."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.binding import Binding, bind
from drivers.bus import BusSettings, Frame, open_link
from drivers.client import STOP_REPEATS, DriveClient
from drivers.codec import Database
from drivers.errors import DatabaseError, EncodeError, LinkError
from drivers.listen import listen
from drivers.mapping import DriveMap, house_map, map_from_table
from drivers.states import translator
from hil.runtime.setup import wire_facts
from hil.signals import RxFlag, new_ticks
from tests.conftest import CONFIGS
from tests.contract.test_drive_map import OTHER_DBC, OTHER_TABLE

HOUSE = CONFIGS / "drives/hil_pmsm.dbc"
DEMAND_END = ' SG_ Alive : 71|4@0+ (1,0) [0|15] "" Inverter\n'
KEY = ' SG_ Key : 63|8@0+ (1,0) [0|255] "" Inverter\n'
START = 'BA_DEF_ SG_ "GenSigStartValue" FLOAT -1e9 1e9;\nBA_DEF_DEF_ "GenSigStartValue" 0;\n'
NONE: dict[str, Any] = {}


def other(**changes: Any) -> DriveMap:
    return dataclasses.replace(map_from_table(tomllib.loads(OTHER_TABLE), "here"), **changes)


def database(folder: Path, *edits: tuple[str, str], more: str = "") -> Database:
    text = OTHER_DBC + more
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    path = folder / "other.dbc"
    path.write_text(text)
    return Database(path)


def refusal(base: Database, drive: DriveMap, load: bool = True) -> str:
    with pytest.raises(DatabaseError) as caught:
        bind(drive, base, load=load)
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


def sent_bits(binding: Binding) -> bytes:
    """A command of nothing but zeros."""
    bound = binding.command
    return bound.encode({name: 0.0 for _, name in bound.parts})


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"u_d": "Demand.Uq"}, "Demand.Uq is named by u_q and u_d"),
        ({"reset": "Demand.On"}, "Demand.On is named by enable and reset"),
        ({"i_d": "MotorCurrent.Iq"}, "MotorCurrent.Iq is named by i_q and i_d"),
        ({"error": "MotorSpeed.Mode"}, "MotorSpeed.Mode is named by state and error"),
        ({"echo": "MotorSpeed.Alive"}, "MotorSpeed.Alive is named by echo and counters"),
        ({"enable": "Demand.Alive"}, "Demand.Alive is named by enable and counters"),
        ({"constants": {"Demand.On": 1, "Demand.Key": 90}}, "Demand.On is named by enable and constants"),
        ({"constants": {"Demand.Uq": 8.192}}, "Demand.Uq is named by u_q and constants"),
        ({"constants": {"Demand.Alive": 3}}, "Demand.Alive is named by constants and counters"),
        ({"counters": ("Demand.Alive", "Demand.Key")}, "counters: Demand has two, Alive and Key"),
        ({"sync": "Demand"}, "sync: Demand is mapped as a frame of signals, too"),
        ({"emergency": "Supply"}, "emergency: Supply is mapped as a frame of signals, too"),
        ({"heartbeat": "Demand"}, "heartbeat: Demand is mapped as a frame of signals, too"),
    ],
)
def test_a_signal_has_one_part(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    assert told in refusal(database(tmp_path), other(**changes))


def test_a_constant_on_a_part_that_this_run_leaves_alone_is_refused_too() -> None:
    base = Database(HOUSE)
    drive = dataclasses.replace(house_map(base), constants={"LOAD_COMMAND.LoadTorque": 5.0})
    assert "LOAD_COMMAND.LoadTorque is named by load_torque and constants" in refusal(base, drive, load=False)


@pytest.mark.parametrize(
    ("edit", "changes", "told"),
    [
        ((KEY, ' SG_ Key : 55|8@0+ (1,0) [0|255] "" Inverter\n'), NONE, "Demand.Key and On share bits"),
        ((KEY, ' SG_ Key : 7|16@0- (1,0) [-300|300] "" Inverter\n'), NONE, "Demand.Key and Uq share bits"),
        ((KEY, ' SG_ Key : 71|8@0+ (1,0) [0|255] "" Inverter\n'), NONE, "Demand.Alive and Key share bits"),
        (("SG_ Ud : 31|24@0-", "SG_ Ud : 15|24@0-"), NONE, "Demand.Ud and Uq share bits"),
        (("SG_ Id : 23|16@0-", "SG_ Id : 15|16@0-"), NONE, "MotorCurrent.Id shares bits with another signal"),
    ],
)
def test_signals_that_share_bits_are_refused(
    tmp_path: Path, edit: tuple[str, str], changes: dict[str, Any], told: str
) -> None:
    assert told in refusal(database(tmp_path, edit), other(**changes))


def test_nothing_is_sent_where_the_crc_goes() -> None:
    base = Database(HOUSE)
    drive = dataclasses.replace(house_map(base), constants={"COMMAND.Crc": 7})
    assert "COMMAND.Crc lies where the E2E CRC goes" in refusal(base, drive)


@pytest.mark.parametrize(
    ("layout", "more", "bits", "said"),
    [
        ("(0.5,-10) [-10|100] ", 'BA_ "GenSigStartValue" SG_ 2566852864 Limit 220;\n', 220, (100.0, "A")),
        ("(0.5,-10) [-10|100] ", 'BA_ "GenSigStartValue" SG_ 2566852864 Limit 20.0;\n', 20, (0.0, "A")),
        ("(1,0) [0|100] ", "", 0, None),
        ("(1,0) [0|100] ", 'BA_ "GenSigStartValue" SG_ 2566852864 Limit 255;\n', 255, (255.0, "A")),
    ],
)
def test_what_nobody_maps_starts_as_the_dbc_says(
    tmp_path: Path, layout: str, more: str, bits: int, said: tuple[float, str] | None
) -> None:
    limit = f' SG_ Limit : 79|8@0+ {layout}"A" Inverter\n'
    base = database(tmp_path, (DEMAND_END, DEMAND_END + limit), more=START + more)
    binding = bind(other(), base)
    assert sent_bits(binding)[9] == bits and sent_bits(binding)[7] == 90
    assert binding.command.payload.started == ((("Limit", *said),) if said else ())


@pytest.mark.parametrize(
    ("layout", "more", "told"),
    [
        (
            "(0.5,-10) [-10|100] ",
            START,
            "Demand.Limit: it would be sent as -10 A, and the DBC has no GenSigSt",
        ),
        ("(1,0) [1|5] ", "", "Demand.Limit: 0 is outside its range 1 .. 5"),
        (
            "(1,0) [0|9] ",
            START + 'BA_ "GenSigStartValue" SG_ 2566852864 Limit 256;\n',
            "256 does not fit its 8",
        ),
        (
            "(1,0) [0|9] ",
            START + 'BA_ "GenSigStartValue" SG_ 2566852864 Limit 1.5;\n',
            "1.5 does not fit its 8",
        ),
        (
            "(1,0) [0|9] ",
            START + 'BA_ "GenSigStartValue" SG_ 2566852864 Limit -1;\n',
            "-1 does not fit its 8",
        ),
    ],
)
def test_what_nobody_knows_how_to_send_is_refused(tmp_path: Path, layout: str, more: str, told: str) -> None:
    limit = f' SG_ Limit : 79|8@0+ {layout}"A" Inverter\n'
    base = database(tmp_path, (DEMAND_END, DEMAND_END + limit), more=more)
    text = refusal(base, other())
    assert told in text and "give it a value in drive.signals.constants" in text
    mapped = bind(other(constants={"Demand.Key": 90, "Demand.Limit": 5}), base)
    assert mapped.command.payload.data[9] == (5 if "(1," in layout else 30)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (300, "300 can't be sent"),
        (-1, "can't be sent"),
        (1.5, "between two steps"),
        (10**400, "can't be sent"),
    ],
)
def test_a_constant_that_does_not_fit_is_refused(tmp_path: Path, value: float, told: str) -> None:
    assert told in refusal(database(tmp_path), other(constants={"Demand.Key": value}))


def test_a_constant_of_64_bits_is_exact(tmp_path: Path) -> None:
    wide = ' SG_ Key : 0|64@1+ (1,0) [0|1.8446744073709552e19] "" Inverter\n'
    moved = ((" SG_ Uq : 7|24@0-", " SG_ Uq : 71|8@0-"), (" SG_ Ud : 31|24@0-", " SG_ Ud : 79|8@0-"))
    moved += ((" SG_ On : 55|1", " SG_ On : 87|1"), (" SG_ ClearFault : 54|1", " SG_ ClearFault : 86|1"))
    moved += ((" SG_ Alive : 71|4", " SG_ Alive : 95|4"), (KEY, wide))
    base = database(tmp_path, *moved)
    binding = bind(other(constants={"Demand.Key": 2**53 + 1}), base)
    assert int.from_bytes(sent_bits(binding)[:8], "little") == 2**53 + 1


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (("[0|15]", "[3|3]"), "has a range in which nothing can be counted"),
        (("[0|15]", "[20|30]"), "has a range in which nothing can be counted"),
        (("71|4@0+ (1,0)", "71|4@0- (1,0)"), "must be a plain unsigned number"),
        (("71|4@0+ (1,0)", "71|4@0+ (2,0)"), "must be a plain unsigned number"),
        (("71|4@0+ (1,0)", "71|4@0+ (1,-3)"), "must be a plain unsigned number"),
        (("71|4@0+ (1,0) [0|15]", "71|16@0+ (1,0) [0|65535]"), "has 16 bits; at most 8 are used"),
    ],
)
def test_counters_that_cannot_count(tmp_path: Path, edit: tuple[str, str], told: str) -> None:
    assert told in refusal(database(tmp_path, (DEMAND_END, DEMAND_END.replace(*edit))), other())


def test_commands_are_counted_together(tmp_path: Path) -> None:
    text = HOUSE.read_text()
    begin = text.index("BO_ 769 LOAD_COMMAND")
    path = tmp_path / "counted.dbc"
    path.write_text(text[:begin] + text[begin:].replace("8|4@1+ (1,0) [0|15]", "8|4@1+ (1,0) [0|14]", 1))
    base = Database(path)
    told = "LOAD_COMMAND.Counter counts 15 numbers, the command 16; they count together"
    assert told in refusal(base, house_map(base))
    bind(house_map(base), base, load=False)


class Peer:
    """A client of the other maker's drive and its far end."""

    def __init__(self, base: Database, drive: DriveMap, kind: str, channel: str) -> None:
        settings = BusSettings(kind, channel, fd=True)
        self.link = open_link(settings)
        self.client = DriveClient(open_link(settings), base, drive_map=drive)
        self.tick: Any = new_ticks()[0]
        self.client.prepare(self.tick)

    def command(self, counter: int, controlword: int = 0, u_q: float = 0.0) -> bytes:
        self.tick["counter"], self.tick["controlword"], self.tick["u_q"] = counter, controlword, u_q
        self.client.send(self.tick)
        (frame,) = self.heard()
        return frame.data

    def heard(self) -> list[Frame]:
        out = []
        while (frame := self.link.receive(20_000_000)) is not None:
            out.append(frame)
        return out

    def close(self) -> None:
        self.client.close()
        self.link.close()


@pytest.fixture(params=["hil-local", "virtual"])
def peer(request: pytest.FixtureRequest, channel: str, tmp_path: Path) -> Iterator[Any]:
    made: list[Peer] = []

    def make(*edits: tuple[str, str], **changes: Any) -> Peer:
        made.append(Peer(database(tmp_path, *edits), other(**changes), request.param, channel))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.mark.parametrize(
    ("limits", "counts"), [("0|14", range(15)), ("1|15", range(1, 16)), ("2|5", range(2, 6))]
)
def test_a_counter_keeps_its_range_in_commands_and_in_stop_frames(
    peer: Any, limits: str, counts: range
) -> None:
    one = peer((DEMAND_END, DEMAND_END.replace("0|15", limits)))
    assert one.client.binding.counter_modulus == len(counts)
    seen = [one.command(n)[8] >> 4 for n in range(len(counts))]
    assert seen == list(counts)
    one.client.stop()
    stops = [frame.data[8] >> 4 for frame in one.heard()]
    assert stops == [counts[n % len(counts)] for n in range(STOP_REPEATS)], "the stop goes on counting"


def test_a_counter_of_8_bits_wraps_at_its_range(peer: Any) -> None:
    one = peer((DEMAND_END, ' SG_ Alive : 71|8@0+ (1,0) [0|254] "" Inverter\n'))
    assert [one.command(n)[8] for n in (253, 254)] == [253, 254]
    one.client.stop_from(254)
    assert [frame.data[8] for frame in one.heard()] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("limits", "last", "first"), [("0|14", 14, 0), ("1|15", 15, 1)])
def test_a_received_counter_jumps_where_it_leaves_its_range(
    peer: Any, limits: str, last: int, first: int
) -> None:
    alive = ' SG_ Alive : 31|4@0+ (1,0) [0|15] "" Ecu\n'
    one = peer((alive, alive.replace("0|15", limits)))

    def flags(count: int) -> int:
        one.tick["rx_flags"] = 0
        one.link.send(0x98FF1000, bytes((0, 0, 1, count << 4, 0, 0, 0, 0)))
        one.client.receive(one.tick, 0)
        return int(one.tick["rx_flags"])

    assert [flags(count) for count in (last - 1, last, first, first)] == [0, 0, 0, RxFlag.COUNTER_REPEATED]
    assert flags(first + 2) == RxFlag.COUNTER_JUMP


def test_an_echo_counts_from_where_its_command_does(tmp_path: Path) -> None:
    base = database(
        tmp_path,
        (DEMAND_END, DEMAND_END.replace("0|15", "1|15")),
        (" SG_ Mode : 23|8", ' SG_ Echo : 27|4@0+ (1,0) [0|15] "" Ecu\n SG_ Mode : 23|8'),
    )
    echo = bind(other(echo="MotorSpeed.Echo"), base).signal("echo")
    assert echo and [echo.to_phys(raw) for raw in (1, 15)] == [0, 14]


@pytest.mark.parametrize(
    ("edit", "changes", "told"),
    [
        ((" SG_ On : 55|1@0+", " SG_ On : 55|1@0-"), NONE, "Demand.On: 1 can't be sent"),
        (
            ("On : 55|1@0+ (1,0) [0|1]", "On : 55|1@0+ (2,0) [0|2]"),
            NONE,
            "Demand.On: 1 can't be sent: it is between two",
        ),
        (
            ("On : 55|1@0+ (1,0) [0|1]", "On : 51|4@0+ (1,0) [0|15]"),
            {"enable": "", "controlword": "Demand.On"},
            "Demand.On: 128 can't be sent",
        ),
        (("Uq : 7|24@0- (0.0001,0)", "Uq : 7|24@0- (0.0001,0.00005)"), NONE, "Demand.Uq: 0 can't be sent"),
        (("Ud : 31|24@0- (0.0001,0)", "Ud : 31|24@0- (0.00015,0)"), NONE, "have no common one"),
    ],
)
def test_a_command_that_could_not_say_zero_or_off(
    tmp_path: Path, edit: tuple[str, str], changes: dict[str, Any], told: str
) -> None:
    assert told in refusal(database(tmp_path, edit), other(**changes))


def test_voltages_have_the_range_of_bits_and_dbc_and_the_coarser_step(tmp_path: Path) -> None:
    base = database(
        tmp_path,
        ("Uq : 7|24@0- (0.0001,0) [-400|400]", "Uq : 7|16@0- (0.001,0) [-400|400]"),
        ("Ud : 31|24@0- (0.0001,0) [-400|400]", "Ud : 31|16@0- (0.01,0) [-300|400]"),
    )
    wire = wire_facts(bind(other(), base))
    assert (wire.u_top, wire.u_lsb) == (pytest.approx(32.767), pytest.approx(0.01))
    loaded = wire_facts(bind(house_map(Database(HOUSE)), Database(HOUSE), load=True))
    assert loaded.T_L_top == pytest.approx(327.67) and loaded.T_L_lsb == 0.01


def spoil(client: DriveClient, at: int, bits: int) -> None:
    """A defect as it must not happen: the table under the command says more than the map."""
    client._commanding["messages"]["under"][0][at] |= bits


@pytest.mark.parametrize(
    ("at", "bits"),
    [(0, 0x01), (2, 0x10), (5, 0x40), (6, 0x80), (6, 0x40)],
    ids=["u_q", "u_q", "u_d", "on", "reset"],
)
def test_the_last_line_no_frame_leaves_that_says_more_than_zero(peer: Any, at: int, bits: int) -> None:
    one = peer()
    one.command(0)
    spoil(one.client, at, bits)
    for controlword in (0x00, 0x02, 0x06, 0x07):
        one.tick["counter"], one.tick["controlword"] = 1, controlword
        with pytest.raises(EncodeError, match="Demand: the frame would say something else"):
            one.client.send(one.tick)
    assert one.heard() == []
    one.client.stop()
    assert [frame.data[:7] for frame in one.heard()] == [bytes(7)] * STOP_REPEATS, "these were ready before"


def test_a_client_that_could_not_stop_is_never_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from drivers import client as module

    tables = module.outgoing_tables

    def wrong(binding: Binding) -> Any:
        messages, signals = tables(binding)
        messages["under"][0][1] = 8
        return messages, signals

    monkeypatch.setattr(module, "outgoing_tables", wrong)
    with pytest.raises(EncodeError, match="the frame would say something else"):
        DriveClient(Broken([]), database(tmp_path), drive_map=other())


class Broken:
    """A bus that fails in a way that nobody foresaw."""

    def __init__(self, fails: list[Exception | None]) -> None:
        self.fails, self.sent = fails, list[bytes]()

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        if self.fails and (error := self.fails.pop(0)) is not None:
            raise error
        self.sent.append(data)

    def receive(self, timeout_ns: int) -> Frame | None:
        return None

    def discard(self) -> int:
        return 0

    def close(self) -> None: ...


@pytest.mark.parametrize("error", [ValueError("?"), EncodeError("?"), RuntimeError("?"), LinkError(5, "?")])
def test_stop_goes_past_any_exception(tmp_path: Path, error: Exception) -> None:
    link = Broken([error, None, error])
    client = DriveClient(link, database(tmp_path), drive_map=other())
    client.stop()
    assert len(link.sent) == STOP_REPEATS - 2 and all(data[:7] == bytes(7) for data in link.sent)


def test_stop_goes_past_a_log_that_fails(tmp_path: Path) -> None:
    def fails(records: memoryview) -> None:
        raise RuntimeError("the ring is gone")

    link = Broken([])
    DriveClient(link, database(tmp_path), drive_map=other(), on_frames=fails).stop()
    assert len(link.sent) == STOP_REPEATS


def test_raw_states_with_a_sign_are_what_their_bits_are(tmp_path: Path) -> None:
    base = database(tmp_path, ("SG_ Mode : 23|8@0+ (1,0) [0|255]", "SG_ Mode : 23|8@0- (1,0) [-128|127]"))
    binding = bind(other(states={-1: "fault", 0: "off", 1: "operation enabled"}), base)
    state, translate = binding.signal("state"), translator(binding.map.states, lambda: 0)
    assert state and translate
    assert [translate(int(state.to_phys(raw))) for raw in (255, 1, 0, 254)] == [7, 4, 1, 0]
    assert bind(binding.map, base).map == binding.map, "a bound map binds again"
    wrong = other(states={300: "fault", 0: "off", 1: "operation enabled"})
    assert "states: 300 does not fit the 8 bits of Mode" in refusal(base, wrong)
    never_off = other(states={0: "operation enabled", 9: "fault"})
    assert "states: no value shows the drive switched off" in refusal(base, never_off)


def test_listening_knows_a_counters_range_and_odd_lengths(tmp_path: Path, channel: str) -> None:
    alive = ' SG_ Alive : 31|4@0+ (1,0) [0|15] "" Ecu\n'
    base = database(tmp_path, (alive, alive.replace("0|15", "1|14")))
    settings = BusSettings("hil-local", channel, fd=True)
    link, far = open_link(settings), open_link(settings)
    for count in (13, 14, 1, 2, 4):
        far.send(0x98FF1000, bytes((0, 0, 1, count << 4, 0, 0, 0, 0)))
    far.send(0x98FF1000, bytes(6))
    heard = listen(link, base, 1.0, {"MotorSpeed": "Alive"}).of("MotorSpeed")
    assert (heard.jumps, heard.invalid, heard.odd_length) == (1, 1, 6)
    link.close()
    far.close()


def test_a_frame_of_another_length_is_named(peer: Any) -> None:
    one = peer()
    one.link.send(0x98FF1001, bytes(6))
    one.client.receive(one.tick, 0)
    assert one.tick["rx_flags"] == RxFlag.LENGTH_ERROR
    assert one.client.odd_length() == "MotorCurrent: length 6, DBC 8"


def test_values_of_stop_frames_are_zero_for_every_counter() -> None:
    base = Database(HOUSE)
    client = DriveClient(Broken([]), base, load=True)
    for ready in client._stops:
        for counter, frame in enumerate(ready):
            values = frame.message.decode(frame.raw[8 : 8 + frame.message.length].tobytes())
            assert values["Counter"] == counter
            assert not np.any(
                [values.get(n, 0) for n in ("Controlword", "VoltageQ", "VoltageD", "LoadTorque")]
            )
