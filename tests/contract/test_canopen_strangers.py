"""`hil configure` sets up a drive on a CANopen stack of strangers (durand), by the EDS that it makes."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from drivers.errors import DatabaseError, NodeError
from hil.runtime.configure import compare, configure
from tests.canopen import NODE, durand_drive, job

pytestmark = pytest.mark.alone

Refused = (DatabaseError, NodeError)


@pytest.fixture
def eds(configs: Path, channel: str) -> Iterator[str]:
    """A durand drive on the channel; the setting of its EDS."""
    path = configs / "durand.eds"
    with durand_drive(channel, path):
        yield f'canopen.eds="{path}"'


def test_it_is_set_up_and_moves_with_sync(configs: Path, channel: str, eds: str) -> None:
    """Every object is held; then PDOs by hand: a state a SYNC, shown with the next; torque, milli-rpm."""
    made = job(configs, channel, eds)
    result = configure(made, store=False, dbc=configs / "drives" / "cia402.dbc")
    assert all(held.ok for held in result.objects) and compare(made).problems == []
    assert result.units == {"rated_torque": "13.68 N m (6076h)", "unit_of_speed": "0.001 rpm (60A9h)"}
    with can.Bus(channel, "hil-local") as bus:
        say = speaker(bus)
        say(0x000, bytes((1, NODE)))
        words = [tick(bus, say, word, 500) for word in (0x06, 0x07, 0x0F, 0x0F, 0x0F, 0x0F)]
    assert [word & 0x6F for word, _, _ in words] == [0x40, 0x40, 0x21, 0x23, 0x27, 0x27]
    assert words[-1][1] > 0 and 0 < words[-2][2] < words[-1][2] <= 500


def speaker(bus: can.BusABC) -> Callable[[int, bytes], None]:
    return lambda can_id, data: bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def tick(bus: can.BusABC, say: Callable[[int, bytes], None], word: int, torque: int) -> tuple[int, int, int]:
    """SYNC, its answer, then a command that the next SYNC latches."""
    say(0x080, b"")
    end = time.monotonic() + 5.0
    while time.monotonic() < end:
        message = bus.recv(0.1)
        if message is not None and message.arbitration_id == 0x180 + NODE:
            say(0x200 + NODE, struct.pack("<Hh", word, torque))
            statusword, velocity, torque_now = struct.unpack("<Hih", message.data)
            return statusword, velocity, torque_now
    raise AssertionError("no answer to SYNC")


@pytest.mark.corners
@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["canopen.rpdo_timeout_ms=10"], "has no object 1400h:5 (deadline of the command"),
        (['canopen.mode="csv"'], "has no object 60FFh (RPDO1)"),
        (['canopen.tpdo=[["6041","6079"]]'], "has no object 6079h (TPDO1)"),
    ],
)
def test_what_it_does_not_have(configs: Path, channel: str, eds: str, settings: list[str], said: str) -> None:
    with pytest.raises(Refused) as refused:
        configure(job(configs, channel, eds, *settings), store=False, dbc=None)
    assert said in str(refused.value)


def test_the_period_of_sync(configs: Path, channel: str, eds: str) -> None:
    """Held as it was written; one that their server does not take is told with its abort's words."""
    made = job(configs, channel, eds, "canopen.sync_period=true")
    result = configure(made, store=False, dbc=configs / "drives" / "cia402.dbc")
    assert ("1006h", 1000, 1000) in [(str(o.entry.place), o.wanted, o.found) for o in result.objects]
    assert compare(made).problems == []
    with pytest.raises(NodeError) as refused:
        configure(
            job(configs, channel, eds, "canopen.sync_period=true", "loop.rate_hz=100"), store=False, dbc=None
        )
    assert "1006h can't be set to 0x2710: abort 0x06090031, " in str(refused.value)
    assert not [problem for problem in compare(made).problems if "1006h" in problem], "it holds the old one"


def test_it_can_store_nothing(configs: Path, channel: str, eds: str) -> None:
    with pytest.raises(DatabaseError, match=r"no object 1010h:1"):
        configure(job(configs, channel, eds), store=True, dbc=None)
