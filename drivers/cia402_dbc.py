"""The DBC of a CiA 402 drive's cyclic frames, with units: what the compiled tick reads and writes.

Identifiers are those of node 1, as in every DBC here: ``drive.node_id`` moves them.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from cantools.database.can import Database, Message, Node, Signal
from cantools.database.conversion import LinearConversion

from drivers.cia402 import Mapped, Pdo, Plan
from drivers.codec import Database as Frames
from drivers.scales import Scales

_ONE: Final = Fraction(1)
_NMT_STATES: Final = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
_COMMANDS: Final = {1: "start", 2: "stop", 128: "enter pre-operational", 129: "reset node"}
CONTROLLER, DRIVE = "Controller", "Drive"


def dbc_of(plan: Plan, node_id: int, scales: Scales, period_ms: float, heartbeat_ms: int, what: str) -> str:
    """The DBC's text. Raises as :class:`drivers.scales.Scales` does. ``what``: the drive, for a comment."""
    cycle = round(period_ms) or None
    messages = [
        _message(0x000, "NMT", 2, [_plain("Command", 0, 8, _COMMANDS), _plain("Node", 8, 8)], CONTROLLER),
        _message(0x080, "SYNC", 0, [], CONTROLLER, cycle),
        _message(0x081, "EMCY", 8, [_plain("ErrorCode", 0, 16), _plain("ErrorRegister", 16, 8)], DRIVE),
        *(_pdo(pdo, node_id, scales, cycle) for pdo in plan.pdos),
        _message(0x701, "HEARTBEAT", 1, [_plain("NmtState", 0, 8, _NMT_STATES)], DRIVE, heartbeat_ms or None),
    ]
    nodes = [Node(CONTROLLER), Node(DRIVE)]
    made = Database(messages=messages, nodes=nodes, version="1")
    comment = f"{what}, mode {plan.mode}: made by hil configure from its EDS and its own units, for node 1."
    text: str = made.as_dbc_string(sort_signals=None)
    return text.replace("\r\n", "\n").rstrip("\n") + f'\nCM_ "{comment}";\n'


def differences(text: str, path: Path, node_id: int, plan: Plan) -> list[str]:
    """What the DBC in a file says else than ``text`` about the frames of a plan. Raises DatabaseError."""
    made, kept = (Frames(path, node_id, text=one) for one in (text, None))
    return [
        f"{path}: {pdo.name} (0x{pdo.cob_id:X}): {mistake}"
        for pdo in plan.pdos
        for mistake in _unlike(made.message(pdo.name), kept.of_frame(pdo.cob_id))
    ]


def _unlike(made: Any, kept: Any) -> Iterator[str]:
    """Length and signals by their bits; names are anybody's own."""
    if kept is None or kept.length != made.length:
        has = f"{kept.length} bytes" if kept else "no such message"
        yield f"{made.length} bytes, the DBC has {has}"
        return
    theirs = {signal.shift: _words(signal) for signal in kept.signals.values()}
    for name, signal in made.signals.items():
        if theirs.get(signal.shift) != _words(signal):
            has = theirs.get(signal.shift, "nothing there")
            yield f"{name} is {_words(signal)} from bit {signal.shift} on, the DBC has {has}"


def _words(signal: Any) -> str:
    sign = "signed" if signal.signed else "unsigned"
    return f"{signal.length} bits {sign} of {signal.scale:.12g} {signal.unit}".rstrip()


def _pdo(pdo: Pdo, node_id: int, scales: Scales, cycle: int | None) -> Any:
    signals = [_signal(one, scales) for one in pdo.objects]
    sender = CONTROLLER if pdo.sent else DRIVE
    return _message(pdo.cob_id - node_id + 1, pdo.name, pdo.length, signals, sender, cycle)


def _signal(one: Mapped, scales: Scales) -> Any:
    """A mapped object as a signal in its unit."""
    scale = None if one.place.sub else scales.of(one.place.index)
    factor = scale.factor if scale else _ONE
    ends = (-(1 << one.length - 1), (1 << one.length - 1) - 1) if one.signed else (0, (1 << one.length) - 1)
    unit, comment = (scale.unit if scale else ""), f"{one.place} of the object dictionary."
    return _linear(one.name, one.bit, one.length, factor, unit, (one.signed, *ends), comment)


def _plain(name: str, bit: int, length: int, choices: dict[int, str] | None = None) -> Any:
    bounds = False, 0, (1 << length) - 1
    return _linear(name, bit, length, _ONE, "", bounds, None, choices)


def _linear(
    name: str,
    bit: int,
    length: int,
    factor: Fraction,
    unit: str,
    bounds: tuple[bool, int, int],
    comment: str | None,
    choices: Any = None,
) -> Any:
    signed, low, high = bounds
    scale: int | float = int(factor) if factor.denominator == 1 else float(factor)
    return Signal(
        name,
        bit,
        length,
        is_signed=signed,
        conversion=LinearConversion.factory(scale=scale, offset=0, choices=choices, is_float=False),
        minimum=float(low * factor),
        maximum=float(high * factor),
        unit=unit or None,
        comment=comment,
    )


def _message(
    can_id: int, name: str, length: int, signals: list[Any], sender: str, cycle: int | None = None
) -> Any:
    return Message(can_id, name, length, signals, senders=[sender], cycle_time=cycle)
