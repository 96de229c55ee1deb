"""docs/protocol.md against the DBC that it describes: every frame, identifier and data id of it."""

from __future__ import annotations

import re

import cantools
import pytest

from drivers.codec import Database
from firmware_model.config import Firmware
from tests.conftest import CONFIGS, ROOT
from tests.unit.test_protocol import crc8_long_hand

PAGE = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")
HOUSE = Database(CONFIGS / "drives" / "hil_pmsm.dbc")
EXAMPLES = re.findall(r"^\| (\w+) \| `(\w{3})#(\w+)` \| (.+) \|$", PAGE, re.MULTILINE)
IDENTIFIERS = re.findall(r"^\| (\w+) \| (\w{3}) \| (controller|drive|emulator) \|", PAGE, re.MULTILINE)
DATA_IDS = re.findall(r"^\| (\w+) \| `(\w{32})` \|$", PAGE, re.MULTILINE)


def test_the_page_has_all_messages() -> None:
    assert {name for name, *_ in IDENTIFIERS} == set(HOUSE.messages)
    assert {name for name, *_ in EXAMPLES} == set(HOUSE.messages) - {"TRUTH"}


@pytest.mark.parametrize(("name", "can_id", "sender"), IDENTIFIERS)
def test_identifiers_and_senders(name: str, can_id: str, sender: str) -> None:
    parsed = cantools.database.load_string(HOUSE.text, "dbc").get_message_by_name(name)
    assert HOUSE.message(name).can_id == parsed.frame_id == int(can_id, 16)
    assert parsed.senders == ["Controller" if sender == "controller" else "Drive"]


@pytest.mark.parametrize(("name", "can_id", "data", "meaning"), EXAMPLES)
def test_an_example_is_what_it_says(name: str, can_id: str, data: str, meaning: str) -> None:
    values = {key: float(value) for key, value in re.findall(r"(\w+) = ([-\d.]+)", meaning)}
    message = HOUSE.message(name)
    assert message.can_id == int(can_id, 16) and message.encode(values) == bytes.fromhex(data)
    decoded = message.decode(bytes.fromhex(data))
    assert {key: decoded[key] for key in values} == pytest.approx(values)
    assert set(message.signals) - set(values) <= {"Crc"}


@pytest.mark.parametrize(("name", "ids"), DATA_IDS)
def test_data_ids_and_the_checksum_over_them(name: str, ids: str) -> None:
    parsed = cantools.database.load_string(HOUSE.text, "dbc").get_message_by_name(name)
    assert parsed.dbc.attributes["E2EDataIDs"].value == ids
    frame = next(bytes.fromhex(data) for of, _, data, _ in EXAMPLES if of == name)
    picked = bytes.fromhex(ids)[frame[1] & 15 : (frame[1] & 15) + 1]
    assert crc8_long_hand(frame[1:] + picked) == frame[0]


def test_the_checksum_by_hand_and_the_watchdog() -> None:
    over, result = re.findall(r"CRC-8 over `([\w ]+)` is (0x\w+)", PAGE)[0]
    assert crc8_long_hand(bytes.fromhex(over)) == int(result, 16)
    assert f"for {Firmware().watchdog_ms:g} ms" in PAGE
