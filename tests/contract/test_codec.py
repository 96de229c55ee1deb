"""The compiled codec against cantools, against bytes worked out by hand, and against bad DBC files."""

from __future__ import annotations

import random
from pathlib import Path

import cantools
import pytest
from cantools.autosar.end_to_end import compute_profile2_crc, compute_profile5_crc

from drivers.binding import bind
from drivers.codec import Database, Message
from drivers.e2e import crc_profile_2, crc_profile_5
from drivers.errors import DatabaseError, DecodeError, EncodeError
from drivers.mapping import house_map
from tests.conftest import CONFIGS

HOUSE = CONFIGS / "drives/hil_pmsm.dbc"
FD = CONFIGS / "drives/hil_pmsm_fd.dbc"
NAMES = [(path, name) for path in (HOUSE, FD) for name in Database(path).messages]


def crc8_long_hand(data: bytes) -> int:
    """x^8 + x^5 + x^3 + x^2 + x + 1 (0x2F), bit by bit; independent of the table."""
    crc = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            top = crc >> 7 ^ byte >> bit & 1
            crc = crc << 1 & 0xFF ^ (0x2F if top else 0)
    return crc ^ 0xFF


def crc16_long_hand(data: bytes) -> int:
    """x^16 + x^12 + x^5 + 1 (0x1021), bit by bit."""
    crc = 0xFFFF
    for byte in data:
        for bit in range(7, -1, -1):
            top = crc >> 15 ^ byte >> bit & 1
            crc = crc << 1 & 0xFFFF ^ (0x1021 if top else 0)
    return crc


def with_crc8(body: str, data_id: int) -> bytes:
    """CRC in front of a frame's bytes 1.."""
    rest = bytes.fromhex(body)
    return bytes((crc8_long_hand(rest + bytes((data_id,))),)) + rest


# each body worked out on paper from the layout: counter nibbles, then little-endian raw numbers
BY_HAND = [
    # Counter 3, Echo 2; 80 rad/s = 8000 = 0x1F40; -1.5 A = -1500 = 0xFA24; 0.25 A = 25 = 0x019 and State 4,
    # Limited 1 in the top nibble: 1100b = 0xC, so bytes 19 C0
    (
        "FEEDBACK",
        {
            "Counter": 3,
            "Echo": 2,
            "Speed": 80.0,
            "CurrentQ": -1.5,
            "CurrentD": 0.25,
            "State": 4,
            "Limited": 1,
        },
        with_crc8("23 401F 24FA 19C0", 0xD5),
    ),
    # Counter 15, ProtocolVersion 1; 560 V = 5600 = 0x15E0; 25 degC = 65 = 0x41; -40 degC = 0; 0x3210
    (
        "STATUS",
        {
            "Counter": 15,
            "ProtocolVersion": 1,
            "DcLinkVoltage": 560.0,
            "TemperatureMotor": 25.0,
            "TemperatureInverter": -40.0,
            "ErrorCode": 0x3210,
        },
        with_crc8("1F E015 41 00 1032", 0xEF),
    ),
    # Counter 0; controlword 0x000F; -3.27 V = -327 = 0xFEB9; 327.67 V = 0x7FFF
    (
        "COMMAND",
        {"Counter": 0, "Controlword": 15, "VoltageQ": -3.27, "VoltageD": 327.67},
        with_crc8("00 0F00 B9FE FF7F", 0x39),
    ),
    # Counter 10, Enable in bit 12; 5.4 N m = 540 = 0x021C
    ("LOAD_COMMAND", {"Counter": 10, "Enable": 1, "LoadTorque": 5.4}, with_crc8("1A 1C02", 0x8B)),
    ("SYNC", {"SyncCounter": 240}, b"\xf0"),
    ("HEARTBEAT", {"NmtState": 5}, b"\x05"),
    ("EMCY", {"ErrorCode": 0x2310, "ErrorRegister": 1}, bytes.fromhex("1023010000000000")),
    # 1.0f = 0x3F800000, -2.5f = 0xC0200000
    ("TRUTH", {"LoadTorqueTrue": 1.0, "SpeedTrue": -2.5}, bytes.fromhex("0000803F000020C0")),
]


@pytest.mark.parametrize(("name", "values", "expected"), BY_HAND, ids=[case[0] for case in BY_HAND])
def test_bytes_by_hand(name: str, values: dict[str, float], expected: bytes) -> None:
    message = Database(HOUSE).message(name)
    assert message.encode(values).hex(" ") == expected.hex(" ")
    decoded = message.decode(expected)
    assert {key: decoded[key] for key in values} == pytest.approx(values)


def test_fd_bytes_by_hand() -> None:
    # counter 200, controlword 6, LoadEnable bit 48, 1.5 V = 1500000 = 0x16E360, -1 V = 0xFFF0BDC0,
    # 2 N m = 2000000 = 0x1E8480
    body = bytes.fromhex("C8 00 0600 0100 60E31600 C0BDF0FF 80841E00")
    body += bytes(62 - len(body))
    crc = crc16_long_hand(body + b"\x5f\x31")
    values = {
        "Counter": 200,
        "Controlword": 6,
        "LoadEnable": 1,
        "VoltageQ": 1.5,
        "VoltageD": -1.0,
        "LoadTorque": 2.0,
    }
    assert Database(FD).message("COMMAND").encode(values).hex(" ") == (crc.to_bytes(2, "little") + body).hex(
        " "
    )


def test_the_whole_layout_of_identifiers() -> None:
    ids = {name: hex(message.can_id) for name, message in Database(HOUSE, node_id=5).messages.items()}
    assert ids == {
        "SYNC": "0x80",
        "FEEDBACK": "0x185",
        "STATUS": "0x285",
        "COMMAND": "0x205",
        "LOAD_COMMAND": "0x305",
        "EMCY": "0x85",
        "TRUTH": "0x485",
        "HEARTBEAT": "0x705",
    }


def test_crc_check_values() -> None:
    # AUTOSAR CRC library: CRC8H2F and CRC16 of "123456789"
    assert crc8_long_hand(b"123456789") == 0xDF and crc16_long_hand(b"123456789") == 0x29B1


def test_e2e_equals_cantools() -> None:
    rng = random.Random(7)
    for round_ in range(300):
        data = rng.randbytes(rng.choice((3, 4, 8, 12, 64)))
        ids = rng.randbytes(16)
        assert crc_profile_2(data, ids) == compute_profile2_crc(data, ids[data[1] & 15]), round_
        if len(data) >= 4:
            data_id = rng.randrange(1 << 16)
            assert crc_profile_5(data, data_id) == compute_profile5_crc(data, data_id), round_


@pytest.mark.parametrize(("path", "name"), NAMES, ids=[f"{path.stem}-{name}" for path, name in NAMES])
def test_protection_equals_cantools(path: Path, name: str) -> None:
    message = Database(path).message(name)
    if not message.profile:
        assert message.valid(bytes(message.length))
        return
    attributes = cantools.database.load_file(path).get_message_by_name(name).dbc.attributes
    ids = bytes.fromhex(attributes["E2EDataIDs"].value)
    rng = random.Random(11)
    for round_ in range(100):
        data = bytearray(rng.randbytes(message.length))
        message.protect(data)
        if message.profile == 2:
            assert data[0] == compute_profile2_crc(bytes(data), ids[data[1] & 15]), round_
        else:
            expected = compute_profile5_crc(bytes(data), int.from_bytes(ids, "big"))
            assert int.from_bytes(data[:2], "little") == expected, round_
        assert message.valid(bytes(data))
        flipped = bytearray(data)
        flipped[rng.randrange(message.length)] ^= 1 << rng.randrange(8)
        assert not message.valid(bytes(flipped)), f"one flipped bit unseen, round {round_}"


def _random_values(message: Message, rng: random.Random) -> dict[str, float]:
    """Values that lie exactly on a step, within the DBC's range."""
    out = {}
    for name, signal in message.signals.items():
        if signal.is_float:
            out[name] = rng.uniform(-1e3, 1e3)
        else:
            out[name] = rng.randint(*signal.raw_range()) * signal.scale + signal.offset
    return out


@pytest.mark.parametrize(("path", "name"), NAMES, ids=[f"{path.stem}-{name}" for path, name in NAMES])
def test_both_directions_equal_cantools(path: Path, name: str) -> None:
    message = Database(path).message(name)
    reference = cantools.database.load_file(path).get_message_by_name(name)
    rng = random.Random(13)
    for round_ in range(100):
        values = _random_values(message, rng)
        data = message.encode(values)
        theirs = bytearray(reference.encode(values, strict=False))
        message.protect(theirs)
        assert data == bytes(theirs), (round_, values)
        assert message.decode(data) == {
            k: float(v) for k, v in reference.decode(data, decode_choices=False).items()
        }, round_


def test_missing_signals_are_zero_and_the_order_of_the_others_is_any() -> None:
    command = Database(HOUSE).message("COMMAND")
    data = command.encode({"VoltageQ": -1.5, "Counter": 3})
    assert data == command.encode({"Counter": 3, "VoltageQ": -1.5})
    given = {"Counter": 3.0, "VoltageQ": -1.5}
    assert command.decode(data) == dict.fromkeys(command.signals, 0.0) | {"Crc": data[0]} | given


@pytest.mark.parametrize("value", [327.68, -327.68, 1e30, float("nan"), float("inf"), float("-inf")])
def test_what_does_not_fit_raises(value: float) -> None:
    command = Database(HOUSE).message("COMMAND")
    with pytest.raises(EncodeError, match="VoltageQ"):
        command.encode({"VoltageQ": value})


@pytest.mark.parametrize("value", [1e39, float("nan"), float("inf")])
def test_what_does_not_fit_a_float_raises(value: float) -> None:
    with pytest.raises(EncodeError, match="SpeedTrue"):
        Database(HOUSE).message("TRUTH").encode({"SpeedTrue": value})


def test_a_signal_that_is_not_there_raises() -> None:
    with pytest.raises(EncodeError, match="COMMAND has no signal Voltage"):
        Database(HOUSE).message("COMMAND").encode({"Voltage": 1.0})


def test_decode_takes_a_frame_whole_or_not_at_all() -> None:
    message = Database(HOUSE).message("FEEDBACK")
    good = message.encode({"Counter": 1, "Speed": 1.0})
    with pytest.raises(DecodeError, match="7 bytes instead of 8"):
        message.decode(good[:7])
    with pytest.raises(DecodeError, match="wrong CRC"):
        message.decode(bytes((good[0] ^ 1,)) + good[1:])


def _edited(tmp_path: Path, old: str, new: str) -> Path:
    text = HOUSE.read_text(encoding="cp1252")
    assert old in text
    path = tmp_path / "edited.dbc"
    path.write_text(text.replace(old, new), encoding="cp1252")
    return path


def _refusal(path: Path, message: str = "FEEDBACK", *signals: str) -> str:
    with pytest.raises(DatabaseError) as caught:
        Database(path).message(message, *signals)
    assert len(str(caught.value).splitlines()) == 1
    assert path.name in str(caught.value)
    return str(caught.value)


def test_a_missing_file(tmp_path: Path) -> None:
    assert "can't be read" in _refusal(tmp_path / "none.dbc")


@pytest.mark.parametrize("text", ["", "no dbc", "BO_ 1 A: 8 X\n SG_ ", "\x00\x01"])
def test_text_that_is_no_dbc(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.dbc"
    path.write_text(text)
    _refusal(path)


def test_a_missing_message_and_a_missing_signal_are_named() -> None:
    assert "no message FEEDBACKS; it has COMMAND" in _refusal(HOUSE, "FEEDBACKS")
    assert "message FEEDBACK has no signal Spin; it has Crc, Counter" in _refusal(HOUSE, "FEEDBACK", "Spin")


def _with_message_twice(number: str, name: str) -> str:
    """The house DBC with FEEDBACK once more, under another identifier or name."""
    text = HOUSE.read_text(encoding="cp1252")
    begin = text.index("BO_ 385 FEEDBACK:")
    block = text[begin : text.index("BO_ ", begin + 1)]
    return text.replace(block, block + block.replace("BO_ 385 FEEDBACK:", f"BO_ {number} {name}:"))


@pytest.mark.parametrize(
    ("number", "name", "words"),
    [
        ("385", "FEEDBACK", "message FEEDBACK is there 2 times"),
        ("386", "FEEDBACK", "message FEEDBACK is there 2 times"),
        ("385", "OTHER", "identifier 0x181 is that of FEEDBACK and OTHER"),
    ],
)
def test_a_message_that_is_there_twice(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], number: str, name: str, words: str
) -> None:
    path = tmp_path / "twice.dbc"
    path.write_text(_with_message_twice(number, name), encoding="cp1252")
    refusal = _refusal(path)
    assert words in refusal and "leave one of each" in refusal and "\n" not in refusal
    assert capfd.readouterr().err == ""
    path.write_text(_with_message_twice("386", "OTHER"), encoding="cp1252")
    assert Database(path).message("OTHER").can_id == 386


def test_overlapping_signals(tmp_path: Path) -> None:
    path = _edited(tmp_path, "SG_ Speed : 16|16@1-", "SG_ Speed : 10|16@1-")
    database = Database(path)
    with pytest.raises(DatabaseError, match=r"FEEDBACK\.Speed shares bits .* \(overlapping\)"):
        bind(house_map(database), database)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('BA_ "E2EProfile" BO_ 385 2;', 'BA_ "E2EProfile" BO_ 385 3;', "E2EProfile 3 is not one of 0, 2, 5"),
        ("1F3C95D5C7DE55A30E20A9AA542B23D9", "1F3C", "E2EDataIDs must be 16 bytes"),
        ("1F3C95D5C7DE55A30E20A9AA542B23D9", "XY3C95D5C7DE55A30E20A9AA542B23D9", "E2EDataIDs must be"),
        ("SG_ Speed : 16|16@1- (0.01,0)", "SG_ Speed : 16|16@1- (0,0)", "scale 0"),
        ("SG_ Speed : 16|16@1-", "SG_ Speed : 50|16@1-", "does not fit into 8 bytes"),
    ],
)
def test_a_message_that_cannot_be_used(tmp_path: Path, old: str, new: str, text: str) -> None:
    path = _edited(tmp_path, old, new)
    refusal = _refusal(path, "FEEDBACK", *(name for name in ("Speed", "Counter") if f"SG_ {name}" in new))
    assert text in refusal and "FEEDBACK" in refusal
    assert "SYNC" in Database(path).messages, "other messages stay usable"


def test_both_byte_orders_in_one_message(tmp_path: Path) -> None:
    path = tmp_path / "mixed.dbc"
    path.write_text(
        'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: X Y\n\nBO_ 2147484161 M: 4 X\n'
        ' SG_ A : 0|8@1+ (1,0) [0|255] "" Y\n SG_ B : 15|16@0- (1,0) [-32768|32767] "" Y\n'
        ' SG_ C : 24|8@1- (1,0) [-128|127] "" Y\n'
    )
    message = Database(path).message("M")
    assert message.encode({"A": 1, "B": -2, "C": -3}) == bytes.fromhex("01 FFFE FD")
    assert message.decode(bytes.fromhex("01 FFFE FD")) == {"A": 1, "B": -2, "C": -3}
    assert message.extended and message.can_id == 513 and message.send_id == 513 | 0x80000000
    assert Database(path, node_id=5).message("M").can_id == 513, "only CANopen's 11-bit identifiers move"
