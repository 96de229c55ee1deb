"""Mistakes of a drive map that concern more than one signal; each is one line, what is right says nothing."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from drivers.bound import Binding, Bound
from drivers.codec import Message
from drivers.mapping import COMMANDED_Q, SENT, STATES, STATUSWORD, DriveMap
from drivers.node import NodeRule
from drivers.payload import EXACT, misfit
from drivers.signal import Signal
from drivers.states import CONTROLWORDS

Pair = tuple[str, str]
"""A message and a signal of it."""


@dataclass(frozen=True, slots=True)
class Names:
    """What a map names: parts received and sent in this run, all that could be sent, counters by message."""

    received: Mapping[str, Pair]
    sent: Mapping[str, Pair]
    all_sent: tuple[tuple[str, Pair], ...]
    counters: Mapping[str, str]


def mistakes_of_map(drive: DriveMap, names: Names) -> Iterator[str]:
    """Of the names alone."""
    for part in drive.required:
        if not getattr(drive, part):
            yield f'{part}: missing; name it as "MESSAGE.Signal"'
    yield from _one_command(drive)
    if not (drive.controlword or drive.enable):
        yield "controlword or enable: one of them must be named, or the drive can't be switched off"
    received, sent = ({name for name, _ in places.values()} for places in (names.received, names.sent))
    for name in sorted(received & sent):
        yield f"{name} is both received and sent; a frame has one sender"
    yield from _polled(drive, {name for name, _ in names.sent.values()})
    for text in drive.expect:
        if (name := text.partition(".")[0]) not in received:
            yield f"expect: {name} is no message that is read"
    for name in names.counters:
        if name not in received and all(name != message for _, (message, _) in names.all_sent):
            yield f"counters: {name} is no message of this map"
    yield from _twice(drive, names)
    yield from _states(drive)
    known = {**names.received, **dict(names.all_sent)}
    for text in drive.units:
        if text not in known and tuple(text.split(".", 1)) not in known.values():
            yield f"units: {text} is no part of this map"


def _one_command(drive: DriveMap) -> Iterator[str]:
    """A drive takes one quantity, and says one way what flows."""
    named = [part for part in COMMANDED_Q if getattr(drive, part)]
    if len(named) > 1:
        yield f"{' and '.join(named)}: the drive takes one of them; leave the others out"
    if drive.u_d and not drive.u_q:
        yield "u_d: a drive that takes a current or a torque takes no voltage; leave it out"
    if drive.i_d_ref and not drive.i_q_ref:
        yield "i_d_ref: goes with i_q_ref; leave it out"
    if drive.torque and drive.i_q:
        yield "i_q and torque: one of them tells what flows; leave the other out"


def _polled(drive: DriveMap, sent: set[str]) -> Iterator[str]:
    """A drive that answers its command alone gets that in SYNC's place, and has no other."""
    if not drive.poll:
        return
    lead = next((text for part in COMMANDED_Q if (text := getattr(drive, part))), "").partition(".")[0]
    if drive.poll != lead:
        yield f"poll: {drive.poll} is not the message with the command; that is {lead or 'missing'}"
    if drive.sync or drive.step:
        yield "poll: the drive's cycle begins with its command; leave sync and step out"
    if others := ", ".join(sorted(sent - {drive.poll})):
        yield f"poll: all that is sent must be in {drive.poll}; {others} would go out beside it"


def mistakes_of_changes(made: Binding) -> Iterator[str]:
    """What is sent on change alone is no frame that counts or carries the command."""
    names = [bound.message.name for bound in made.outgoing]
    for name in made.map.on_change:
        if name not in names:
            yield f"on_change: {name} is no message of the command"
        elif name == names[-1]:
            yield f"on_change: {name} carries the command, which each tick sends"
        elif any(bound.counter for bound in made.outgoing if bound.message.name == name):
            yield f"on_change: {name} has a counter, which changes with each tick; leave one out"


def _twice(drive: DriveMap, names: Names) -> Iterator[str]:
    """A signal has one part: named twice, one of its values would reach nobody, or both as their OR."""
    roles: dict[Pair, list[str]] = defaultdict(list)
    for part, pair in (*names.received.items(), *names.all_sent):
        roles[pair].append(part)
    for text in drive.constants:
        message, _, signal = text.partition(".")
        roles[message, signal].append("constants")
    for message, signal in names.counters.items():
        roles[message, signal].append("counters")
    for (message, signal), named in roles.items():
        if len(named) > 1:
            yield f"{message}.{signal} is named by {' and '.join(named)}; a signal has one part"


def _states(drive: DriveMap) -> Iterator[str]:
    states = drive.states
    if isinstance(states, str):
        if states != STATUSWORD:
            yield f'states = "{states}": a table of raw value = name, or "{STATUSWORD}"'
        return
    for raw, name in states.items():
        if name not in STATES:
            yield f'states: {raw} = "{name}"; known are {", ".join(STATES)}'
    if states and "operation enabled" not in states.values():
        yield 'states: no value is "operation enabled"; the drive could never be seen running'
    if states and not set(states.values()) - {"operation enabled", "fault", "fault reaction active"}:
        yield "states: no value shows the drive switched off; nobody could see it stop"


def plain_states(drive: DriveMap, state: Signal | None) -> DriveMap:
    """The map with each raw state as the signal's bits show it, without a sign."""
    if isinstance(drive.states, str) or not drive.states or state is None:
        return drive
    end = 1 << state.length
    fits = {raw: name for raw, name in drive.states.items() if -state.raw_bias <= raw < end}
    return replace(drive, states={raw % end: name for raw, name in fits.items()})


def mistakes_of_states(drive: DriveMap, state: Signal) -> Iterator[str]:
    """Raw states that the signal does not show, or two that look the same on the wire."""
    if isinstance(drive.states, str):
        if state.length < 7:
            yield f"state: {state.name} has {state.length} bits; 7 of a statusword's 16 tell the state"
        return
    end = 1 << state.length
    for raw in drive.states:
        if not (-state.raw_bias <= raw < end):
            yield f"states: {raw} does not fit the {state.length} bits of {state.name}"
    if len({raw % end for raw in drive.states}) < len(drive.states):
        yield f"states: two raw values are the same {state.length} bits of {state.name}; leave one"


def mistakes_of_frames(made: Binding, node: NodeRule) -> Iterator[str]:
    """Each mapped message has an identifier of its own, which the drive's node number reaches."""
    signals = {bound.message.name: bound.message for bound in made.incoming + made.outgoing}
    sent = {bound.message.name for bound in made.outgoing}
    messages = dict(signals)
    if made.nmt is not None and (made.nmt.send_id, made.nmt.length) != (0x000, 2):
        yield f"nmt: {made.nmt.name} is not CANopen's: identifier 0x000, 2 bytes"
    for part in ("sync", "emergency", "heartbeat"):
        message: Message | None = getattr(made, part)
        if message is None:
            continue
        if message.name in (sent if part == "heartbeat" else signals):
            yield f"{part}: {message.name} is mapped as a frame of signals, too; it can't be both"
        messages[message.name] = message
    by_id: dict[int, str] = {}
    for name, message in messages.items():
        first = by_id.setdefault(message.send_id, name)
        if first != name:
            yield f"{first} and {name} both have the identifier 0x{message.can_id:X}"
        if message.fixed and node.node_id != 1:
            yield (
                f"{name} has the identifier 0x{message.can_id:X}, which node_id = {node.node_id} does not "
                "move (it is none of CANopen's for node 1); leave drive.node_id out, or say where the number "
                'goes: drive.node_rule = "id << 5"'
            )


def mistakes_of_values(made: Binding) -> Iterator[str]:
    """Of what will be sent: stopping must never fail on a range, and both axes have one step."""
    yield from mistakes_of_changes(made)
    why = made.outgoing[-1].message.unwatched if made.outgoing else ""
    if why and not made.map.unwatched:
        yield f"{made.outgoing[-1].message.name}: {why}; take a mode that is watched, or say unwatched = true"
    for bound in made.outgoing:
        yield from _unsendable(bound)
    names = ("u_q", "u_d") if made.map.u_q else ("i_q_ref", "i_d_ref")
    u_q, u_d = (made.signal(name) for name in names)
    if u_q is not None and u_d is not None:
        ratio = max(u_q.step, u_d.step) / min(u_q.step, u_d.step)
        if abs(ratio - round(ratio)) > ratio * EXACT:
            yield (
                f"{' and '.join(names)}: steps of {u_q.step:g} and {u_d.step:g} {u_q.unit} have no common "
                "one; correct the DBC"
            )
    for bound in made.outgoing[:-1]:
        if bound.counter and bound.counter_modulus > 0 and made.counter_modulus % bound.counter_modulus:
            yield (
                f"counters: {bound.message.name}.{bound.counter} counts {bound.counter_modulus} numbers, the "
                f"command {made.counter_modulus}; they count together, give both the same range"
            )


def _unsendable(bound: Bound) -> Iterator[str]:
    """Zero, and every word that is sent, that a signal does not fit."""
    for part, name in bound.parts:
        words: tuple[float, ...] = CONTROLWORDS if part == "controlword" else (0.0, 1.0)
        for value in words if not SENT[part].units else (0.0,):
            if problem := misfit(bound.message.signals[name], value):
                yield f"{bound.message.name}.{name}: {problem}"
