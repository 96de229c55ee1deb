"""Messages of which each frame carries other signals: read by their selector, sent with a fixed one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.binding import bind
from drivers.bus import BusSettings, open_link
from drivers.client import DriveClient
from drivers.codec import Database
from drivers.listen import listen
from drivers.mapping import DriveMap
from hil.signals import RxFlag, new_ticks
from tests.contract.test_map_bits import refusal

DBC = """VERSION ""

BO_ 385 Say: 8 Drive
 SG_ What M : 0|8@1+ (1,0) [0|255] "" Me
 SG_ Count : 8|4@1+ (1,0) [0|15] "" Me
 SG_ Mode : 12|4@1+ (1,0) [0|15] "" Me
 SG_ Speed m0 : 16|16@1- (0.1,0) [-3000|3000] "rad/s" Me
 SG_ Iq m0 : 32|16@1- (0.01,0) [-300|300] "A" Me
 SG_ Id m144 : 16|16@1- (0.01,0) [-300|300] "A" Me
 SG_ Udc m7 : 16|16@1+ (0.1,0) [0|1000] "V" Me

BO_ 513 Do: 8 Me
 SG_ What M : 0|8@1+ (1,0) [0|255] "" Drive
 SG_ On : 8|1@1+ (1,0) [0|1] "" Drive
 SG_ Uq m144 : 16|16@1- (0.01,0) [-300|300] "V" Drive
 SG_ Ud m144 : 32|16@1- (0.01,0) [-300|300] "V" Drive
 SG_ Torque m1 : 16|16@1- (0.01,5) [-300|300] "N m" Drive
 SG_ Gain m1 : 32|8@1+ (1,0) [0|255] "" Drive

BA_DEF_ SG_ "GenSigStartValue" INT 0 65535;
BA_DEF_DEF_ "GenSigStartValue" 0;
"""
MAP = {
    "speed": "Say.Speed", "i_q": "Say.Iq", "i_d": "Say.Id", "v_dc": "Say.Udc", "state": "Say.Mode",
    "u_q": "Do.Uq", "u_d": "Do.Ud", "enable": "Do.On",
}  # fmt: skip


def made(folder: Path, *edits: tuple[str, str], **changes: Any) -> tuple[Database, DriveMap]:
    text = DBC
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    path = folder / "mux.dbc"
    path.write_text(text)
    counted: Any = {**MAP, "counters": ("Say.Count",), **changes}
    return Database(path), DriveMap(**counted)


class Bench:
    """A client and its far end."""

    def __init__(self, base: Database, drive: DriveMap, kind: str, channel: str) -> None:
        settings = BusSettings(kind, channel)
        self.link = open_link(settings)
        self.client = DriveClient(open_link(settings), base, drive_map=drive)
        self.tick: Any = new_ticks()[0]
        self.client.prepare(self.tick)
        self._count = -1

    def say(self, what: int, *values: int, skip: int = 0) -> int:
        self._count = (self._count + 1 + skip) % 16
        body = b"".join(value.to_bytes(2, "little", signed=True) for value in values).ljust(6, b"\0")
        self.link.send(0x181, bytes((what, self._count | 1 << 4)) + body)
        self.tick["rx_flags"] = 0
        self.client.receive(self.tick, 0)
        return int(self.tick["rx_flags"])


@pytest.fixture(params=["hil-local", "virtual"])
def bench(request: pytest.FixtureRequest, channel: str, tmp_path: Path) -> Iterator[Bench]:
    one = Bench(*made(tmp_path), request.param, channel)
    yield one
    one.client.close()
    one.link.close()


def test_a_frame_is_read_by_its_selector(bench: Bench) -> None:
    assert bench.say(0, 100, -250) == 0
    assert bench.say(144, 30) == RxFlag.FRESH, "all that measures has come"
    tick = bench.tick
    assert (tick["w"], tick["i_q"], tick["i_d"]) == pytest.approx((10.0, -2.5, 0.3))
    assert bench.say(7, 5600) == RxFlag.STATUS and tick["v_dc"] == pytest.approx(560.0)
    assert tick["w"] == pytest.approx(10.0), "another selector's bits are no speed"


def test_frames_of_no_interest_count_too(bench: Bench) -> None:
    assert [bench.say(0, 1), bench.say(9, 77), bench.say(144, 2)] == [0, 0, RxFlag.FRESH]
    assert bench.say(9, skip=2) == RxFlag.COUNTER_JUMP
    assert bench.tick["i_d"] == pytest.approx(0.02)


def test_two_frames_of_one_selector_are_no_pair(bench: Bench) -> None:
    assert [bench.say(0, 1), bench.say(0, 2), bench.say(0, 3)] == [0, 0, 0]
    assert bench.say(144, 2) == RxFlag.FRESH


def test_a_command_has_its_selector_for_ever(bench: Bench) -> None:
    for controlword, u_q in ((0x06, 0.0), (0x0F, 1.5)):
        bench.tick["controlword"], bench.tick["u_q"] = controlword, u_q
        bench.client.send(bench.tick)
    bench.client.stop()
    frames = []
    while (frame := bench.link.receive(20_000_000)) is not None:
        frames.append(frame.data)
    assert frames[1].hex(" ") == "90 01 96 00 00 00 00 00"
    assert frames[0] == frames[2] == frames[-1] == bytes((0x90, *[0] * 7))
    assert len(frames) == 7


def test_signals_behind_another_selector_are_not_in_the_command(tmp_path: Path) -> None:
    base, drive = made(tmp_path)
    bind(drive, base)  # Torque's raw 0 is 5 N m, but it lies behind 1
    base, drive = made(tmp_path, (" m1 : 16|16@1- (0.01,5)", " m144 : 48|16@1- (0.01,5)"))
    assert "Do.Torque: it would be sent as 5 N m" in refusal(base, drive)


@pytest.mark.parametrize(
    ("edits", "changes", "told"),
    [
        ([("Ud m144", "Ud m145")], {}, "Do.What can't have one value for all that is sent"),
        ([], {"constants": {"Do.What": 1}}, "Do.What can't have one value for all that is sent"),
        ([], {"constants": {"Do.Gain": 1}}, "Do.What can't have one value for all that is sent"),
        ([], {"reset": "Do.What"}, "Do.What is the multiplexer"),
        ([("SG_ Id m144 : 16", "SG_ Id m0 : 24")], {}, "shares bits with another signal"),
    ],
)
def test_what_can_not_be_one_frame_is_refused(
    tmp_path: Path, edits: list[tuple[str, str]], changes: dict[str, Any], told: str
) -> None:
    assert told in refusal(*made(tmp_path, *edits, **changes))


def test_a_constant_may_say_what_the_selector_is(tmp_path: Path) -> None:
    base, drive = made(tmp_path, constants={"Do.What": 144})
    assert bind(drive, base).command.payload.data == bytes((144, *[0] * 7))


def test_signals_of_several_selectors(tmp_path: Path, channel: str) -> None:
    ranges = ("BA_DEF_ SG_", "SG_MUL_VAL_ 385 Udc What 7-9, 20-20;\nBA_DEF_ SG_")
    one = Bench(*made(tmp_path, ranges), "hil-local", channel)
    assert [one.say(what, 100 * what) for what in (8, 20, 10)] == [RxFlag.STATUS, RxFlag.STATUS, 0]
    assert one.tick["v_dc"] == pytest.approx(200.0)
    one.client.close()
    one.link.close()


def test_listening_keeps_each_selectors_newest(tmp_path: Path, channel: str) -> None:
    base, _ = made(tmp_path)
    link, far = (open_link(BusSettings("hil-local", channel)) for _ in range(2))
    for data in (bytes((0, 0x10, 100, 0, 0, 0, 0, 0)), bytes((7, 0x11, 0xE0, 0x15, 0, 0, 0, 0))):
        far.send(0x181, data)
    values = listen(link, base, 1.0, {"Say": "Count"}).of("Say").values
    assert values["Speed"] == pytest.approx(10.0) and values["Udc"] == pytest.approx(560.0)
    assert "Id" not in values
    link.close()
    far.close()
