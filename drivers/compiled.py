"""Unrolled readers, writers and checks of one message, generated from its DBC at start.

A frame a tick goes through these, so they are straight-line code. Nothing of a DBC's text enters the
generated source: only numbers and names made here. Equality with :mod:`drivers.signal` is tested.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Callable, Sequence
from typing import Any

from drivers.e2e import CRC8_TABLE
from drivers.signal import FLOAT_FORMATS, Signal

Reader = Callable[[bytes], tuple[float, ...]]
Writer = Callable[..., bytes]
_WORDS = {1: "B", 2: "H", 4: "I", 8: "Q"}


def build(name: str, lines: Sequence[str], namespace: dict[str, Any]) -> Any:
    """Compile a function of generated lines."""
    exec("\n".join(lines), namespace)  # noqa: S102 - the source is made of numbers alone, see above
    return namespace[name]


def _words(length: int) -> list[tuple[int, int]]:
    """Start and width [bytes] of the machine words that cover a frame; empty when they can't."""
    words = [(start, 8) for start in range(0, length - 7, 8)]
    rest = length % 8
    if rest not in (0, *_WORDS):
        return []
    return words + ([(length - rest, rest)] if rest else [])


def _place(signal: Signal, length: int, words: list[tuple[int, int]]) -> tuple[str, int]:
    """Name of the word (or of the whole frame as one integer) that holds a signal, and its shift there."""
    order = "b" if signal.big_endian else "l"
    for index, (start, width) in enumerate(words):
        below = 8 * (length - start - width) if signal.big_endian else 8 * start
        if below <= signal.shift and signal.shift + signal.length <= below + 8 * width:
            return f"{order}{index}", signal.shift - below
    return order, signal.shift


def _bits(signal: Signal, word: str, shift: int) -> str:
    """Expression of the raw number."""
    mask = (1 << signal.length) - 1
    bits = f"({word} >> {shift} & {mask})"
    if signal.is_float:
        return f"f{signal.length}({bits})"
    if signal.signed:
        half = 1 << (signal.length - 1)
        return f"(({bits} ^ {half}) - {half})"
    return bits


def _phys(signal: Signal, raw: str, whole: bool) -> str:
    """Expression of the physical value; adding 0 is left out where it can't change a bit (no -0)."""
    plain = signal.offset == 0.0 and not signal.is_float and signal.scale > 0.0
    if whole and plain and signal.scale == 1.0:
        return raw
    value = f"{raw} * {signal.scale!r}" + ("" if plain else f" + {signal.offset!r}")
    return f"round({value})" if whole else value


def _float_reader(length: int) -> Callable[[int], float]:
    integer, real = (struct.Struct(text) for text in FLOAT_FORMATS[length])
    return lambda bits: float(real.unpack(integer.pack(bits))[0])


def _float_writer(length: int) -> Callable[[float], int]:
    integer, real = (struct.Struct(text) for text in FLOAT_FORMATS[length])
    return lambda value: int(integer.unpack(real.pack(value))[0])


def value_lines(
    length: int, signals: Sequence[Signal], whole: Sequence[bool], start: int = 0
) -> tuple[list[str], list[str], dict[str, Any]]:
    """Lines that take a frame apart, an expression for each value, and the names that both need.

    The frame is called ``raw``; its data are ``length`` bytes from ``start`` on.
    """
    words = _words(length)
    places = [_place(signal, length, words) for signal in signals]
    used = {word for word, _ in places}
    namespace: dict[str, Any] = {f"f{n}": _float_reader(n) for n in FLOAT_FORMATS}
    lines: list[str] = []
    for order, mark, name in (("l", "<", "little"), ("b", ">", "big")):
        if order in used:
            data = f"raw[{start}:{start + length}]" if start else "raw"
            lines.append(f"{order} = int.from_bytes({data}, {name!r})")
        wanted = [f"{order}{index}" for index in range(len(words)) if f"{order}{index}" in used]
        if wanted:
            layout = f"{mark}{start}x" + "".join(
                _WORDS[width] if f"{order}{index}" in used else f"{width}x"
                for index, (_, width) in enumerate(words)
            )
            unpack = struct.Struct(layout)
            namespace[f"unpack_{name}"] = unpack.unpack_from if start else unpack.unpack
            lines.append(f"{', '.join(wanted)}, = unpack_{name}(raw)")
    values = [
        _phys(signal, _bits(signal, *place), want)
        for signal, place, want in zip(signals, places, whole, strict=True)
    ]
    return lines, values, namespace


def make_reader(length: int, signals: Sequence[Signal], whole: Sequence[bool]) -> Reader:
    """A function from a frame's bytes to physical values; those marked ``whole`` come as int."""
    lines, values, namespace = value_lines(length, signals, whole)
    source = ["def read(raw):", *(f"    {line}" for line in lines)]
    source.append(f"    return ({', '.join(values)}{',' if values else ''})")
    reader: Reader = build("read", source, namespace)
    return reader


def make_writer(
    length: int, signals: Sequence[Signal], protect: Callable[[bytes], bytes], refuse: Callable[..., bytes]
) -> Writer:
    """A function from physical values to a frame's bytes; ``refuse`` raises for values that don't fit."""
    arguments = ", ".join(f"v{index}" for index in range(len(signals)))
    namespace: dict[str, Any] = {f"p{n}": _float_writer(n) for n in FLOAT_FORMATS}
    namespace |= {"protect": protect, "refuse": refuse}
    lines = [f"def write({arguments}):", "    try:"]
    lines += [f"        {_raw_line(index, signal)}" for index, signal in enumerate(signals)] or [
        "        pass"
    ]
    lines += ["    except (ValueError, OverflowError, TypeError):", f"        return refuse({arguments})"]
    checks = " and ".join(_check(index, signal) for index, signal in enumerate(signals)) or "True"
    lines += [f"    if not ({checks}):", f"        return refuse({arguments})"]
    lines.append(f"    return protect({_frame(length, signals)})")
    writer: Writer = build("write", lines, namespace)
    return writer


def _raw_line(index: int, signal: Signal) -> str:
    plain = signal.offset == 0.0 and signal.scale == 1.0 and not signal.is_float
    value = f"v{index}" if plain else f"(v{index} - {signal.offset!r}) / {signal.scale!r}"
    return f"r{index} = p{signal.length}({value})" if signal.is_float else f"r{index} = round({value})"


def _check(index: int, signal: Signal) -> str:
    if signal.is_float:
        top = 1.7976931348623157e308
        return f"{max(signal.minimum, -top)!r} <= v{index} <= {min(signal.maximum, top)!r}"
    low, high = signal.raw_range()
    return f"{low} <= r{index} <= {high}"


def _frame(length: int, signals: Sequence[Signal]) -> str:
    """Expression of the unprotected bytes."""
    parts: dict[bool, list[str]] = {False: [], True: []}
    for index, signal in enumerate(signals):
        bits = f"r{index} & {(1 << signal.length) - 1}" if signal.signed else f"r{index}"
        parts[signal.big_endian].append(f"({bits}) << {signal.shift}")
    little, big = (" | ".join(parts[order]) or "0" for order in (False, True))
    if not parts[True]:
        return f"({little}).to_bytes({length}, 'little')"
    if not parts[False]:
        return f"({big}).to_bytes({length}, 'big')"
    swapped = f"int.from_bytes(({big}).to_bytes({length}, 'big'), 'little')"
    return f"({little} | {swapped}).to_bytes({length}, 'little')"


def _crc8(length: int, start: int = 0) -> str:
    """Expression of profile 2's CRC of a frame called ``raw``, unrolled."""
    crc = "255"
    for index in range(start + 1, start + length):
        crc = f"T[{crc} ^ raw[{index}]]"
    return f"T[{crc} ^ I[raw[{start + 1}] & 15]] ^ 255"


def crc_lines(profile: int, length: int, ids: bytes, start: int) -> tuple[str, dict[str, Any]]:
    """Expression that is true for a frame ``raw`` with the right CRC, "" for no CRC, and its names."""
    if profile == 2:
        return f"raw[{start}] == {_crc8(length, start)}", {"T": CRC8_TABLE, "I": ids}
    if profile == 0:
        return "", {}
    inner = f"crc_hqx(raw[{start + 2}:{start + length}], 65535)"
    check = f"raw[{start}] | raw[{start + 1}] << 8 == crc_hqx(tail, {inner})"
    return check, {"crc_hqx": crc_hqx, "tail": bytes(reversed(ids))}


def make_crc(profile: int, length: int, ids: bytes) -> Callable[[bytes], int]:
    """The CRC of a whole frame of ``length`` bytes, unrolled for profile 2."""
    if profile == 2:
        source = f"def crc(raw): return {_crc8(length)}"
        function: Callable[[bytes], int] = build("crc", [source], {"T": CRC8_TABLE, "I": ids})
        return function
    tail = bytes(reversed(ids))  # profile 5: the 16-bit id, low byte last in the attribute's order
    return lambda data: crc_hqx(tail, crc_hqx(data[2:], 0xFFFF))


def make_protection(profile: int, length: int, ids: bytes) -> tuple[Callable[[bytes], bool], Writer]:
    """(valid, protect) of a profile: is the CRC right; the same bytes with the right CRC."""
    if profile == 0:
        return lambda data: True, lambda data: data
    crc = make_crc(profile, length, ids)
    if profile == 2:
        heads = [bytes((value,)) for value in range(256)]
        return lambda data: data[0] == crc(data), lambda data: heads[crc(data)] + data[1:]
    return (
        lambda data: data[0] | data[1] << 8 == crc(data),
        lambda data: crc(data).to_bytes(2, "little") + data[2:],
    )
