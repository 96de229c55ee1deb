"""The codec under drawn bytes: what decodes encodes to the same numbers; what does not is refused."""

from __future__ import annotations

import math
from pathlib import Path

from drivers.codec import Database, Message
from drivers.errors import DecodeError, EncodeError
from tests.fuzz.draw import Draw

DRIVES = Path(__file__).resolve().parents[2] / "configs" / "drives"
MESSAGES = [
    message
    for name in ("hil_pmsm.dbc", "hil_pmsm_fd.dbc")
    for message in Database(DRIVES / name).messages.values()
]


def take(data: bytes) -> None:
    """One frame of one message, then one set of values for it."""
    draw = Draw(data)
    message = draw.pick(MESSAGES)
    frame = bytearray(draw.bytes(message.length if not draw.one_in(4) else draw.below(65)))
    if len(frame) == message.length and not draw.one_in(4):
        message.protect(frame)
    try:
        values = message.decode(bytes(frame))
    except DecodeError:
        assert len(frame) != message.length or not message.valid(bytes(frame))
    else:
        there_and_back(message, values)
    encode(message, draw)


def there_and_back(message: Message, values: dict[str, float]) -> None:
    """A decoded frame encodes to one that decodes to the same numbers, or is out of the DBC's range."""
    if not all(map(math.isfinite, values.values())):
        return
    try:
        again = message.encode(values)
    except EncodeError as refused:
        assert "does not fit" in str(refused)
    else:
        back = message.decode(again)
        back["Crc"] = values.get("Crc", 0.0)  # made anew, over bits that no signal has
        assert back == {"Crc": 0.0, **values}


def encode(message: Message, draw: Draw) -> None:
    """Drawn values are encoded within half a step of the wire, or refused."""
    values = {name: draw.number(1.0, 100.0, 327.67) for name in message.signals}
    try:
        frame = message.encode(values)
    except EncodeError:
        return
    assert message.valid(frame) and len(frame) == message.length
