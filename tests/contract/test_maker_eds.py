"""`hil configure` by a servo maker's whole EDS, e35.eds of canopen's source, on that library's node."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cantools
import pytest
from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.datatypes import INTEGER_TYPES
from canopen.profiles.p402 import State402

from drivers.states import of_statusword
from hil.runtime.configure import compare, configure
from hil.signals import DriveState
from tests.canopen import E35, NODE, job, stranger

pytestmark = pytest.mark.alone
SHOWN = {0x6041: 0x40, 0x6061: 10, 0x6072: 3000, 0x6076: 13680, 0x60A9: 0xFDB44700, 0x6502: 0x3FF}
"""What a node that is no drive must be told to say: state, mode, limits, units."""


@pytest.fixture
def drive(channel: str) -> Iterator[Any]:
    with stranger(channel, NODE, E35) as node:
        for found in node.object_dictionary.values():
            for one in [found] if isinstance(found, ODVariable) else found.values():
                if one.data_type in INTEGER_TYPES and one.default is None:
                    node.set_data(one.index, one.subindex, bytes(len(one) // 8))
        yield node


def test_it_is_set_up_by_the_whole_eds(configs: Path, channel: str, drive: Any) -> None:
    """Each object of the mapping is held and nothing else written: its values are of another node, 32."""
    for index, value in SHOWN.items():
        drive.sdo[index].raw = value
    made = job(configs, channel, f'canopen.eds="{E35}"')
    before = {index: drive.sdo[index].raw for index in (0x1006, 0x100C, 0x1014, 0x6065)}
    result = configure(made, store=False, dbc=configs / "drives" / "cia402.dbc")
    assert result.written and all(held.ok for held in result.objects) and not result.problems
    assert result.units == {"rated_torque": "13.68 N m (6076h)", "unit_of_speed": "0.001 rpm (60A9h)"}
    assert {index: drive.sdo[index].raw for index in before} == before
    assert drive.sdo[0x1A00][2].raw == 0x606C0020 and drive.sdo[0x1600][2].raw == 0x60710010
    assert drive.sdo[0x6060].raw == 10 and compare(made).problems == []
    frames = {
        m.name: m for m in cantools.database.load_file(str(made.base / "drives" / "cia402.dbc")).messages
    }
    assert {signal.name for signal in frames["TPDO1"].signals} == {"Statusword", "Velocity", "Torque"}


def test_each_statusword_is_the_state_that_strangers_read() -> None:
    """All 65536 by canopen's table of CiA 402."""
    for word in range(1 << 16):
        theirs = [name for name, (mask, value) in State402.SW_MASK.items() if word & mask == value]
        ours = DriveState(of_statusword(word)).name.replace("_", " ")
        assert [ours] == theirs or (not theirs and ours == "NOT READY TO SWITCH ON"), hex(word)
