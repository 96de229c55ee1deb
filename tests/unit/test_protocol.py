"""The house protocol: bytes worked out by hand, protection checked by cantools' own E2E code."""

from __future__ import annotations

import math

import cantools
import pytest
from cantools.autosar import compute_profile2_crc, compute_profile5_crc
from hypothesis import given
from hypothesis import strategies as st

from drivers.codec import Database
from drivers.e2e import crc_profile_2, crc_profile_5
from drivers.errors import DatabaseError, DecodeError, EncodeError
from tests.conftest import CONFIGS

pytestmark = pytest.mark.slow

CLASSIC, FD = CONFIGS / "drives" / "hil_pmsm.dbc", CONFIGS / "drives" / "hil_pmsm_fd.dbc"
HOUSE, HOUSE_FD = Database(CLASSIC), Database(FD)


def crc8_long_hand(data: bytes) -> int:
    """CRC-8/AUTOSAR bit by bit: polynomial 0x2F, start 0xFF, inverted at the end."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F) & 0xFF if crc & 0x80 else crc << 1 & 0xFF
    return crc ^ 0xFF


def data_ids(database: Database, name: str) -> bytes:
    parsed = cantools.database.load_string(database.text, "dbc").get_message_by_name(name)
    return bytes.fromhex(parsed.dbc.attributes["E2EDataIDs"].value)


def test_the_check_value_of_the_crc() -> None:
    assert crc8_long_hand(b"123456789") == 0xDF  # the catalogue's check value


def test_feedback_by_hand() -> None:
    # counter 5, echo 9 -> 0x95; 80.01 rad/s -> 8001 = 0x1F41; -1.5 A -> -1500 = 0xFA24;
    # i_d -0.03 A -> -3 = 0xFFD in 12 bits; state 4 and limited 1 -> high nibble 0xC
    body = bytes((0x95, 0x41, 0x1F, 0x24, 0xFA, 0xFD, 0xCF))
    frame = bytes((crc8_long_hand(body + data_ids(HOUSE, "FEEDBACK")[5:6]),)) + body
    values = {
        "Counter": 5,
        "Echo": 9,
        "Speed": 80.01,
        "CurrentQ": -1.5,
        "CurrentD": -0.03,
        "State": 4,
        "Limited": 1,
    }
    message = HOUSE.message("FEEDBACK")
    assert message.can_id == 0x181 and message.encode(values) == frame
    decoded = message.decode(frame)
    assert {name: decoded[name] for name in values} == pytest.approx(values)


def test_command_by_hand() -> None:
    # counter 3, mode 0 -> 0x03; controlword 0x000F; 123.45 V -> 12345 = 0x3039; -0.01 V -> 0xFFFF
    body = bytes((0x03, 0x0F, 0x00, 0x39, 0x30, 0xFF, 0xFF))
    frame = bytes((crc8_long_hand(body + data_ids(HOUSE, "COMMAND")[3:4]),)) + body
    message = HOUSE.message("COMMAND")
    values = {"Counter": 3, "Controlword": 15, "VoltageQ": 123.45, "VoltageD": -0.01}
    assert message.can_id == 0x201 and message.encode(values) == frame


@pytest.mark.parametrize(
    ("name", "can_id", "length"),
    [
        ("SYNC", 0x080, 1), ("FEEDBACK", 0x181, 8), ("STATUS", 0x281, 8), ("COMMAND", 0x201, 8),
        ("LOAD_COMMAND", 0x301, 4), ("TRUTH", 0x481, 8), ("EMCY", 0x081, 8), ("HEARTBEAT", 0x701, 1),
    ],
)  # fmt: skip
def test_identifiers_and_lengths(name: str, can_id: int, length: int) -> None:
    message = HOUSE.message(name)
    assert (message.can_id, message.length) == (can_id, length)


def test_a_node_id_moves_everything_but_sync() -> None:
    moved = Database(CLASSIC, 5)
    assert moved.message("FEEDBACK").can_id == 0x185 and moved.message("COMMAND").can_id == 0x205
    assert moved.message("SYNC").can_id == 0x080


@given(data=st.binary(min_size=8, max_size=8))
def test_profile_2_equals_cantools(data: bytes) -> None:
    ids = data_ids(HOUSE, "FEEDBACK")
    assert crc_profile_2(data, ids) == compute_profile2_crc(data, ids[data[1] & 15])


@given(data=st.binary(min_size=64, max_size=64), data_id=st.integers(0, 0xFFFF))
def test_profile_5_equals_cantools(data: bytes, data_id: int) -> None:
    assert crc_profile_5(data, data_id) == compute_profile5_crc(data, data_id)


@pytest.mark.parametrize("database", [HOUSE, HOUSE_FD], ids=["classic", "fd"])
@given(data=st.data())
def test_every_message_decodes_as_cantools_does(database: Database, data: st.DataObject) -> None:
    parsed = cantools.database.load_string(database.text, "dbc")
    for message in database.messages.values():
        raw = data.draw(st.binary(min_size=message.length, max_size=message.length))
        theirs = parsed.get_message_by_name(message.name).decode(raw, decode_choices=False)
        ours = message.reader(*message.signals)(raw)
        for name, value in zip(message.signals, ours, strict=True):
            assert value == float(theirs[name]) or (math.isnan(value) and math.isnan(float(theirs[name])))


@pytest.mark.parametrize("database", [HOUSE, HOUSE_FD], ids=["classic", "fd"])
@given(data=st.data())
def test_encoding_is_undone_by_decoding(database: Database, data: st.DataObject) -> None:
    message = database.message("COMMAND")
    u_q, u_d = (data.draw(st.integers(-32767, 32767)) * 0.01 for _ in range(2))
    counter = data.draw(st.integers(0, 15))
    decoded = message.decode(message.encode({"Counter": counter, "VoltageQ": u_q, "VoltageD": u_d}))
    assert (decoded["VoltageQ"], decoded["VoltageD"]) == pytest.approx((u_q, u_d), abs=1e-9)
    assert decoded["Counter"] == counter


@given(at=st.integers(8, 63))
def test_one_flipped_bit_is_refused_whole(at: int) -> None:
    message = HOUSE.message("FEEDBACK")
    frame = bytearray(message.encode({"Counter": 1, "Speed": 10.0}))
    frame[at // 8] ^= 1 << at % 8
    with pytest.raises(DecodeError, match="wrong CRC"):
        message.decode(bytes(frame))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 400.0, -400.0])
def test_toward_an_actuator_what_does_not_fit_raises(bad: float) -> None:
    with pytest.raises(EncodeError, match="VoltageQ"):
        HOUSE.message("COMMAND").encode({"VoltageQ": bad})


def test_what_is_no_signal_raises() -> None:
    with pytest.raises(EncodeError, match="VoltageX"):
        HOUSE.message("COMMAND").encode({"VoltageX": 1.0})
    with pytest.raises(DecodeError, match="7 bytes instead of 8"):
        HOUSE.message("COMMAND").decode(bytes(7))
    with pytest.raises(DatabaseError, match="has no message NOPE"):
        HOUSE.message("NOPE")
    with pytest.raises(DatabaseError, match="has no signal Torque"):
        HOUSE.message("FEEDBACK", "Torque")
