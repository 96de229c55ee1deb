"""What of a command's frame never changes: constants, start values, the multiplexer; and who owns which bit.

Laid out once, at start: a tick lays only its own values over it. Two signals on one bit would be sent as
their OR, so whatever is sent is refused where it shares a bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

from drivers.codec import CRC_BYTES, Message
from drivers.errors import EncodeError
from drivers.signal import FLOAT_TOPS, Signal

EXACT = 1e-6
"""Of a step: by how much a value may be off what the bits show."""
MOST = 10**308


@dataclass(frozen=True, slots=True)
class Payload:
    """The bytes under a command, before its CRC; ``started``: what goes out though nobody mapped it."""

    data: bytes
    started: tuple[tuple[str, float, str], ...] = ()
    """(signal, physical value, unit), where it is not 0."""


NO_PAYLOAD = Payload(b"")


class Layout:
    """Works out the payload of a sent message; mistakes collect. ``values``: what a tick fills in."""

    def __init__(self, message: Message, values: Iterable[str], constants: Mapping[str, int | float]) -> None:
        self._message, self._values, self._constants = message, set(values), dict(constants)
        self.mistakes: list[str] = []

    def payload(self) -> Payload:
        """The payload; it counts when there are no mistakes."""
        self._select()
        owned = [*self._values, *self._constants]
        self._check_bits(owned)
        frame, started = 0, []
        for name, value in self._constants.items():
            frame |= self._placed(name, self._bits_of(name, value))
        for name, bits in self._rest(owned):
            frame |= self._placed(name, bits)
            if bits:
                signal = self._message.signals[name]
                started.append((name, signal.to_phys(bits), signal.unit))
        return Payload(frame.to_bytes(self._message.length, "little"), tuple(started))

    def _where(self, name: str) -> str:
        return f"{self._message.name}.{name}"

    def _placed(self, name: str, bits: int) -> int:
        return self._message.signals[name].placed(bits, self._message.length)

    def _select(self) -> None:
        """Give each multiplexer the value behind which all lies that is mapped."""
        wanted: dict[str, frozenset[int]] = {}
        for name in (*self._values, *self._constants):
            selector, ids = self._message.behind.get(name, ("", frozenset()))
            if selector:
                wanted[selector] = wanted.get(selector, ids) & ids
        for selector, ids in wanted.items():
            given = self._constants.get(selector)
            if selector in self._values:
                self.mistakes.append(f"{self._where(selector)} is the multiplexer; a tick can't fill it in")
            elif not ids or (given is not None and given not in ids):
                self.mistakes.append(
                    f"{self._where(selector)} can't have one value for all that is sent; map one frame"
                )
            elif given is None:
                self._constants[selector] = min(ids)

    def _active(self) -> Iterator[Signal]:
        """The signals that are in this frame, by its multiplexers' values."""
        for name, signal in self._message.signals.items():
            selector, ids = self._message.behind.get(name, ("", frozenset()))
            at = self._constants.get(selector, self._message.start.get(selector, 0))
            if not selector or at in ids:
                yield signal

    def _bits_of(self, name: str, value: float) -> int:
        """Bits of a constant; a value that they do not show is a mistake."""
        signal = self._message.signals[name]
        if problem := misfit(signal, value):
            self.mistakes.append(f"{self._where(name)}: {problem}")
            return 0
        return signal.to_bits(value)

    def _check_bits(self, owned: list[str]) -> None:
        """No bit may be sent by two, nor where the CRC goes."""
        length = self._message.length
        masks = {name: self._message.signals[name].mask(length) for name in owned}
        protected = (1 << 8 * CRC_BYTES[self._message.profile]) - 1
        for one, other in combinations(sorted(masks), 2):
            if masks[one] & masks[other]:
                self.mistakes.append(
                    f"{self._where(one)} and {other} share bits; map one of them, correct the DBC"
                )
        for name in (name for name, mask in masks.items() if mask & protected):
            self.mistakes.append(f"{self._where(name)} lies where the E2E CRC goes; leave it out")

    def _rest(self, owned: list[str]) -> Iterator[tuple[str, int]]:
        """(signal, bits) of what nobody mapped, but for what shares its bits with something mapped."""
        length = self._message.length
        taken = (1 << 8 * CRC_BYTES[self._message.profile]) - 1
        for name in owned:
            taken |= self._message.signals[name].mask(length)
        free = [one for one in self._active() if not one.mask(length) & taken]
        for signal in free:
            if problem := self._unsure(signal):
                self.mistakes.append(
                    f"{self._where(signal.name)}: {problem}; "
                    "map it, or give it a value in drive.signals.constants"
                )
            else:
                yield signal.name, self._start_bits(signal)
        for name in self._message.odd.keys() & self._message.start.keys():
            if self._message.start[name] != 0.0:
                self.mistakes.append(self._message.odd[name])

    def _unsure(self, signal: Signal) -> str:
        """Why nobody can say what an unmapped signal must be sent as; empty when it is known."""
        start = self._message.start.get(signal.name)
        if start is not None:
            fits = _fits(signal, start)
            return "" if fits else f"its start value {start:g} does not fit its {signal.length} bits"
        zero = signal.to_phys(0)
        if abs(zero) > abs(signal.scale) * EXACT:
            return (
                f"it would be sent as {zero:g} {signal.unit}".rstrip()
                + ", and the DBC has no GenSigStartValue"
            )
        if not signal.minimum <= 0.0 <= signal.maximum:
            low, high = f"{signal.minimum:g}", f"{signal.maximum:g}"
            return f"0 is outside its range {low} .. {high}, and the DBC has no GenSigStartValue"
        return ""

    def _start_bits(self, signal: Signal) -> int:
        """Bits of a start value; GenSigStartValue counts as raw value."""
        start = self._message.start.get(signal.name, 0.0)
        return signal.float_bits(start) if signal.is_float else round(start) & ((1 << signal.length) - 1)


def _fits(signal: Signal, raw: float) -> bool:
    """Do the bits hold a raw number, whatever range the DBC gives?"""
    if not math.isfinite(raw):
        return False
    if signal.is_float:
        return abs(raw) <= FLOAT_TOPS[signal.length]
    return raw == round(raw) and 0 <= raw + signal.raw_bias < 1 << signal.length


def misfit(signal: Signal, value: float) -> str:
    """Why a signal can't carry a value, to a millionth of its step; empty when it can."""
    if abs(value) > MOST:
        return "more than 1e308 can't be sent"
    try:
        bits = signal.to_bits(value)
    except EncodeError as error:
        return f"{value:g} can't be sent: {error}"
    exact = signal.is_float or abs(signal.to_phys(bits) - value) <= signal.step * EXACT
    return "" if exact else f"{value:g} can't be sent: it is between two steps"
