"""Random DBC messages: the compiled codec equals cantools in both directions, whatever the layout."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cantools
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.codec import Database
from drivers.signal import Signal

LENGTHS = (1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
SCALES = ("1", "0.01", "-0.5", "0.001", "2", "0.1", "1E-06")
OFFSETS = ("0", "-40", "12.5", "1000")


def _start(position: int, length: int, big: bool) -> int:
    """DBC start bit of a signal that occupies consecutive bits from ``position`` in its own order."""
    return position // 8 * 8 + 7 - position % 8 if big else position


@st.composite
def dbc_texts(draw: st.DrawFn) -> str:
    """One message of one byte order with signals side by side, gaps between them."""
    size = draw(st.sampled_from(LENGTHS))
    big = draw(st.booleans())
    lines, position, index = [f"BO_ 291 M: {size} X"], 0, 0
    while position < 8 * size and index < 12:
        position += draw(st.integers(0, 5))
        room = 8 * size - position
        real = draw(st.booleans()) and draw(st.booleans()) and room >= 32
        length = draw(st.sampled_from([32, 64] if room >= 64 else [32])) if real else draw(st.integers(1, 40))
        if length > room:
            break
        sign = "-" if real or draw(st.booleans()) else "+"
        scale, offset = (
            ("1", "0") if real else (draw(st.sampled_from(SCALES)), draw(st.sampled_from(OFFSETS)))
        )
        start = _start(position, length, big)
        lines.append(
            f' SG_ S{index} : {start}|{length}@{0 if big else 1}{sign} ({scale},{offset}) [0|0] "" Y'
        )
        lines.append(f"#{index}:{1 if length == 32 else 2}" if real else "")
        position, index = position + length, index + 1
    kinds = [line[1:].split(":") for line in lines if line.startswith("#")]
    body = [line for line in lines if line and not line.startswith("#")]
    tail = [f"SIG_VALTYPE_ 291 S{name} : {kind};" for name, kind in kinds]
    return "\n".join(['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: X Y", "", *body, "", *tail, ""])


def _value(signal: Signal, draw: st.DrawFn) -> float:
    if signal.is_float:
        return draw(st.floats(width=32 if signal.length == 32 else 64, allow_nan=False, allow_infinity=False))
    return draw(st.integers(*signal.raw_range())) * signal.scale + signal.offset


@settings(max_examples=200, deadline=None, derandomize=True)
@given(text=dbc_texts(), data=st.data())
def test_random_messages_equal_cantools(text: str, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "random.dbc"
        path.write_text(text)
        message = Database(path).message("M")
    reference = cantools.database.load_string(text, database_format="dbc").get_message_by_name("M")
    values = {name: _value(signal, data.draw) for name, signal in message.signals.items()}
    payload = message.encode(values)
    assert payload == reference.encode(values, strict=False), text
    noise = data.draw(st.binary(min_size=message.length, max_size=message.length))
    for frame in (payload, noise):
        ours = message.decode(frame)  # raw * scale + offset: a float's -0 reads as 0
        theirs = {name: float(value) + 0.0 for name, value in reference.decode(frame).items()}
        assert repr(ours) == repr(theirs), text
    for name, signal in message.signals.items():
        assert message.reader(name)(payload)[0] == signal.to_phys(_bits(signal, payload)), text


def _bits(signal: Signal, frame: bytes) -> int:
    whole = int.from_bytes(frame, "big" if signal.big_endian else "little")
    return whole >> signal.shift & ((1 << signal.length) - 1)
