"""BLF as Vector's tools write it: each object is the frame that it was, or is missed; none is made up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from hil.exchange.readers.recorded import ERROR, EXTENDED, REMOTE, Recorded
from hil.exchange.recording import Recording
from hil.log.errors import LogError
from tests import blf

T_NS = 1_795_767_827_920_000_000
EIGHT, TWELVE = bytes(range(8)), bytes(range(12))


def read(path: Path, *parts: bytes, partial: bool = False, **more: tuple[int, ...]) -> Recording:
    (path / "a.blf").write_bytes(blf.file_of(*parts, **more))
    return Recording(path / "a.blf", partial=partial)


def one(can_id: int, data: bytes, *, received: bool = False, fd: bool = False) -> Recorded:
    return Recorded(0, "0", can_id, received, fd, data)


OBJECTS: dict[str, tuple[int, bytes, Recorded]] = {
    "sent": (1, blf.message(0x181, EIGHT), one(0x181, EIGHT)),
    "received": (1, blf.message(0x181, EIGHT, way=blf.RECEIVED), one(0x181, EIGHT, received=True)),
    "29 bits": (1, blf.message(blf.EXTENDED | 0x80), one(EXTENDED | 0x80, b"")),
    "remote": (1, blf.message(0x181, remote=True, dlc=5), one(0x181 | REMOTE, bytes(5))),
    "raw DLC of 12": (1, blf.message(0x181, EIGHT, dlc=12), one(0x181, EIGHT)),
    "with its length": (86, blf.message_2(0x181, b"\1"), one(0x181, b"\1")),
    "error": (2, blf.error(), one(ERROR | 0x80, bytes(8), received=True)),
    "error with registers": (73, blf.error_ext(0x204, EIGHT, 1), one(ERROR | 0x80, bytes(8), received=True)),
    "SocketCAN's error": (73, blf.error_ext(0x204, EIGHT, 0), one(ERROR | 0x204, EIGHT, received=True)),
    "FD": (100, blf.fd(0x181, TWELVE), one(0x181, TWELVE, fd=True)),
    "FD received": (100, blf.fd(0x181, TWELVE, way=0), one(0x181, TWELVE, received=True, fd=True)),
    "FD object, classic": (100, blf.fd(0x181, EIGHT, edl=False), one(0x181, EIGHT)),
    "FD 64": (101, blf.fd_64(blf.EXTENDED | 1, TWELVE), one(EXTENDED | 1, TWELVE, fd=True)),
    "FD 64, zeros not kept": (101, blf.fd_64(1, bytes(12), kept=3), one(1, bytes(12), fd=True)),
    "FD 64, classic": (101, blf.fd_64(1, EIGHT, edl=False, way=0), one(1, EIGHT, received=True)),
    "FD error": (104, blf.fd_error(0x204, EIGHT), one(ERROR | 0x80, bytes(8), received=True)),
}


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("packed", [blf.container, lambda data: blf.container(data, 0), bytes])
def test_each_kind_of_object(
    name: str, version: int, packed: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    kind, body, wanted = OBJECTS[name]
    found = read(tmp_path, packed(blf.of(kind, 1_234_567_000, body, version=version)))
    assert list(found.frames()) == [wanted._replace(t_ns=T_NS + 1_234_567_000)]
    assert found.damage is None and not found.notes


REQUESTS = {
    1: blf.message(0x204, EIGHT, way=blf.REQUESTED),
    86: blf.message_2(0x204, EIGHT, way=blf.REQUESTED),
    100: blf.fd(0x204, EIGHT, way=blf.REQUESTED),
    101: blf.fd_64(0x204, EIGHT, way=blf.REQUESTED),
}


@pytest.mark.parametrize(("kind", "body"), REQUESTS.items())
def test_a_request_to_send_is_no_second_frame(kind: int, body: bytes, tmp_path: Path) -> None:
    sent = blf.of(1, 2000, blf.message(0x204, EIGHT))
    found = read(tmp_path, blf.container(blf.of(kind, 1000, body) + sent))
    assert [frame.can_id for frame in found.frames()] == [0x204]
    assert found.notes == ["1 transmit requests (TxRq) left out: what was sent is there as Tx"]


def test_objects_may_go_on_in_the_next_container(tmp_path: Path) -> None:
    data = b"".join(blf.of(1, n * 1000, blf.message(n, bytes([n]))) for n in range(1, 200))
    parts = [blf.container(data[at : at + 101]) for at in range(0, len(data), 101)]
    found = read(tmp_path, *parts)
    assert [frame.can_id for frame in found.frames()] == list(range(1, 200)) and found.damage is None


def test_what_is_no_frame_is_left_out_and_frames_of_other_buses_are_said(tmp_path: Path) -> None:
    others = [blf.of(kind, 0, bytes(40)) for kind in (4, 5, 92, 96, 115)]
    overload = blf.of(3, 0, blf.error())
    found = read(tmp_path, blf.container(b"".join([*others, overload, blf.of(1, 1000, blf.message(1))])))
    assert found.count == 1 and found.damage is None and found.notes == ["1 overload frames left out"]


def test_stamps_of_ten_microseconds_and_a_logger_without_a_clock(tmp_path: Path) -> None:
    coarse = blf.of(1, 1_234_567_890, blf.message(1), ten_us=True)
    found = read(tmp_path, blf.container(coarse), start=(0,) * 8)
    assert [frame.t_ns for frame in found.frames()] == [1_234_560_000]


GOOD = blf.of(1, 1000, blf.message(1))
DAMAGE: dict[str, tuple[bytes, str]] = {
    "an unknown header": (blf.of(1, 2000, blf.message(2), version=3), "1 of 2 frames can't be read"),
    "an object too short": (blf.of(104, 2000, b""), "1 of 2 frames can't be read .*too short"),
    "FD of 13 bytes": (blf.of(100, 0, blf.fd(1, EIGHT).replace(bytes([3, 8]), bytes([3, 13]))), "13 bytes"),
    "no object": (b"\xff" * 40, "no object where one should begin"),
    "half an object": (GOOD[:40], "40 bytes at the end are no whole object"),
    "an object of no bytes": (GOOD[:8] + bytes(24), "an object of 0 bytes"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_what_cannot_be_read_is_told(name: str, tmp_path: Path) -> None:
    bad, text = DAMAGE[name]
    with pytest.raises(LogError, match=text) as refused:
        read(tmp_path, blf.container(GOOD + bad))
    assert "--partial" in str(refused.value) and "\n" not in str(refused.value)
    assert read(tmp_path, blf.container(GOOD + bad), partial=True).count == 1


def test_a_container_packed_in_an_unknown_way_is_missed_and_the_rest_read(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=f"{len(GOOD)} bytes packed by the unknown method 7"):
        read(tmp_path, blf.container(GOOD, 7), blf.container(GOOD))
    assert read(tmp_path, blf.container(GOOD, 7), blf.container(GOOD), partial=True).count == 1
