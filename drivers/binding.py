"""A drive map bound to a DBC: the messages to read and to write, checked whole before anything is sent."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from drivers.bound import MOST_COUNTS, Binding, Bound
from drivers.codec import CRC_BYTES, Database, Message
from drivers.errors import DatabaseError
from drivers.mapcheck import (
    Names,
    mistakes_of_frames,
    mistakes_of_map,
    mistakes_of_states,
    mistakes_of_values,
    plain_states,
)
from drivers.mapping import COMMANDED_Q, MEASURED, RECEIVED, SENT, DriveMap, Part
from drivers.oneshot import Shot, bound_shots
from drivers.payload import NO_PAYLOAD, Layout
from drivers.signal import Signal
from drivers.units import DRIVE_TORQUE, FIRST, shown, unit_of

__all__ = ["MOST_COUNTS", "Binding", "Bound", "bind"]

MOST_EXPECTED = 32
_COUNTER_PLACE = {2: (8, 4), 5: (16, 8)}


def bind(
    drive: DriveMap, database: Database, *, load: bool = True, period_ms: float | None = None
) -> Binding:
    """Bind and check. Raises DatabaseError with all mistakes: names, units, ranges, counters, cycle times."""
    return _Binder(drive, database, load, period_ms).bind()


class _Binder:
    """Collects mistakes while it binds."""

    def __init__(self, drive: DriveMap, database: Database, load: bool, period_ms: float | None) -> None:
        self._map, self._database, self._period_ms = drive, database, period_ms
        self._mistakes: list[str] = []
        self._factors: dict[str, float] = {}
        self._counters = self._counted()
        self._expected = self._expectations()
        skipped = () if load else ("load_torque", "load_enable")
        self._received = self._places(RECEIVED, ())
        self._sent = self._places(SENT, skipped)

    def _add(self, mistake: str) -> None:
        if mistake not in self._mistakes:
            self._mistakes.append(mistake)

    def _pairs(self, what: str, texts: tuple[str, ...]) -> Iterator[tuple[str, str]]:
        """(message, signal) of each ``MESSAGE.Signal`` that is one."""
        for text in texts:
            message, dot, signal = text.partition(".")
            if dot and message and signal:
                yield message, signal
            else:
                self._add(f'{what} = "{text}": write it as "MESSAGE.Signal"')

    def _counted(self) -> dict[str, str]:
        """The counter of each message that has one."""
        out: dict[str, str] = {}
        for message, signal in self._pairs("counters", self._map.counters):
            if message in out:
                self._add(f"counters: {message} has two, {out[message]} and {signal}; leave one")
            out[message] = signal
        return out

    def _expectations(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """(signal, the raw number that it must have) of each message that is taken with that alone."""
        out: dict[str, tuple[str, tuple[int, ...]]] = {}
        for text, value in self._map.expect.items():
            for name, signal in self._pairs("expect", (text,)):
                message = self._message(name, "expect", signal)
                bits = message.signals[signal].length if message else 0
                if name in out:
                    self._add(f"expect: {name} has two, {out[name][0]} and {signal}; leave one")
                if message and not (bits <= MOST_EXPECTED and 0 <= value < 1 << bits):
                    self._add(
                        f"expect: {value} is no raw number of {text}, {bits} bits of at most {MOST_EXPECTED}"
                    )
                out[name] = signal, (int(value),)
        return out

    def _places(self, parts: dict[str, Part], skipped: tuple[str, ...]) -> dict[str, tuple[str, str]]:
        """(message, signal) of each part that the map has."""
        named = {part: getattr(self._map, part) for part in parts if part not in skipped}
        return {part: pair for part, text in named.items() if text for pair in self._pairs(part, (text,))}

    def _shots(self, what: str) -> tuple[Shot, ...]:
        """The frames that are sent once, laid out."""
        return bound_shots(what, getattr(self._map, what), self._database, self._add)

    def _lead(self) -> str:
        """The message with the command; empty for none."""
        return next((self._sent[part][0] for part in COMMANDED_Q if part in self._sent), "")

    def bind(self) -> Binding:
        """Return the binding or raise with all mistakes."""
        incoming = self._incoming()
        outgoing = self._outgoing()
        last = self._lead()
        outgoing.sort(key=lambda bound: bound.message.name == last)
        sync, emergency, heartbeat = (
            self._message(getattr(self._map, name), name) for name in ("sync", "emergency", "heartbeat")
        )
        state = self._state()
        made = Binding(
            plain_states(self._map, state),
            tuple(incoming),
            tuple(outgoing),
            sync,
            emergency,
            heartbeat,
            self._factors,
            self._shots("start"),
            self._shots("stop"),
            self._message(self._map.nmt, "nmt"),
            self._database.node.node_id,
        )
        names = Names(self._received, self._sent, tuple(self._all_sent()), self._counters)
        for mistake in (*mistakes_of_map(self._map, names), *mistakes_of_frames(made, self._database.node)):
            self._add(mistake)
        for mistake in mistakes_of_states(self._map, state) if state else ():
            self._add(mistake)
        self._check_cycles({b.message.name for b in incoming}, (sync, emergency, heartbeat))
        self._check_periods(incoming)
        self._check_echo()
        for mistake in mistakes_of_values(made):
            self._add(mistake)
        if self._mistakes:
            raise DatabaseError(f"{self._database.path}: " + "; ".join(self._mistakes))
        return made

    def _state(self) -> Signal | None:
        """The state's signal as the DBC has it."""
        pair = self._received.get("state")
        message = pair and self._message(pair[0], "state", pair[1])
        return message.signals[pair[1]] if message and pair else None

    def _all_sent(self) -> Iterator[tuple[str, tuple[str, str]]]:
        """(part, (message, signal)) of all that is ever sent, also of a load that this run leaves alone."""
        for part in SENT:
            for pair in self._pairs(part, tuple(filter(None, (getattr(self._map, part),)))):
                yield part, pair

    def _message(self, name: str, part: str, *signals: str) -> Message | None:
        """The message, or None with the mistake noted."""
        if not name:
            return None
        try:
            return self._cycled(self._database.message(name, *signals))
        except DatabaseError as error:
            self._add(f"{part}: {str(error).removeprefix(f'{self._database.path}: ')}")
            return None

    def _cycled(self, message: Message) -> Message:
        """The message as often as the drive is said to send it."""
        cycle_ms = self._map.cycle_ms.get(message.name)
        return message if cycle_ms is None else message.sent_every(cycle_ms)

    def _by_message(self, places: dict[str, tuple[str, str]]) -> dict[str, dict[str, str]]:
        """Signal by part of each message that the places name and that has them all."""
        out: dict[str, dict[str, str]] = {}
        for part, (name, signal) in places.items():
            if self._message(name, part, signal) is not None:
                out.setdefault(name, {})[part] = signal
        return out

    def _incoming(self) -> list[Bound]:
        """The messages to read; of a multiplexed one a bound for each of its frames."""
        bounds = []
        for name, signals in self._by_message(self._received).items():
            message, counter = self._converted(name, signals, RECEIVED)
            for selector, wanted, parts in self._frames(message, signals):
                self._check_shared(message, [*filter(None, (counter,)), *(signal for _, signal in parts)])
                bounds.append(Bound(message, counter, parts, NO_PAYLOAD, selector, wanted))
        return bounds

    def _frames(
        self, message: Message, signals: dict[str, str]
    ) -> Iterator[tuple[str, tuple[int, ...], tuple[tuple[str, str], ...]]]:
        """(multiplexer, its values, (part, signal) pairs) of each kind of frame of a received message.

        What a message must say to be taken is as a multiplexer of one value.
        """
        behind = {part: message.behind[name] for part, name in signals.items() if name in message.behind}
        expected = self._expected.get(message.name)
        if expected and behind:
            self._add(f"expect: {message.name} has a multiplexer, which tells its frames apart; leave it out")
        if not behind:
            yield *(expected or ("", ())), tuple(signals.items())
            return
        selectors = {selector for selector, _ in behind.values()}
        if len(selectors) > 1:
            self._add(
                f"{message.name}: what is mapped lies behind {' and '.join(sorted(selectors))}; map one's"
            )
            return
        (selector,) = selectors
        if self._message(message.name, "multiplexer", selector) is None:
            return
        frames: dict[tuple[tuple[str, str], ...], list[int]] = defaultdict(list)
        for value in sorted({value for _, ids in behind.values() for value in ids})[:MOST_COUNTS]:
            there = [(p, s) for p, s in signals.items() if p not in behind or value in behind[p][1]]
            frames[tuple(there)].append(value)
        for parts, wanted in frames.items():
            yield selector, tuple(wanted), parts

    def _outgoing(self) -> list[Bound]:
        """The messages to write, with what stands under each."""
        by_message = self._by_message(self._sent)
        constants = self._constants(by_message)
        bounds = []
        for name, signals in by_message.items():
            message, counter = self._converted(name, signals, SENT)
            values = [*signals.values(), *filter(None, (counter,))]
            layout = Layout(message, values, constants.get(name, {}))
            bounds.append(Bound(message, counter, tuple(signals.items()), layout.payload()))
            for mistake in layout.mistakes:
                self._add(mistake)
        return bounds

    def _constants(self, by_message: dict[str, dict[str, str]]) -> dict[str, dict[str, int | float]]:
        out: dict[str, dict[str, int | float]] = defaultdict(dict)
        for text, value in self._map.constants.items():
            for name, signal in self._pairs("constants", (text,)):
                if name not in by_message:
                    self._add(f'constants: "{text}": {name} is no message of the command')
                elif self._message(name, "constants", signal) is not None:
                    out[name][signal] = value
        return out

    def _converted(self, name: str, signals: dict[str, str], parts: dict[str, Part]) -> tuple[Message, str]:
        """A message with its parts in SI units and its counter from 0 on, and the counter's name."""
        message = self._cycled(self._database.message(name))
        converted = {
            signal: self._checked(part, parts[part], message.signals[signal], f"{name}.{signal}")
            for part, signal in signals.items()
        }
        counter = self._checked_counter(message)
        if counter:
            converted[counter] = _from_zero(message.signals[counter], message.signals[counter].raw_range()[0])
        return message.with_signals(converted), counter

    def _checked(self, part: str, rule: Part, signal: Signal, where: str) -> Signal:
        """The signal in SI units; unit and range are checked."""
        if rule.signed and not signal.minimum < 0.0 < signal.maximum:
            low, high = f"{signal.minimum:g}", f"{signal.maximum:g}"
            self._add(f"{part}: {where} has the range {low} .. {high}; it must reach below and above 0")
        if part in SENT and signal.is_float and signal.length == 16:
            self._add(f"{part}: {where} is a float of 16 bits, which can be received only")
        if not rule.units:
            return self._checked_plain(part, signal, where)
        factor = self._factor(part, rule.units, signal, where)
        if part == "torque":
            return signal.in_unit("A", factor / (self._map.k_t or 1.0))
        if factor != 1.0:
            self._factors[part] = factor
        return signal if factor == 1.0 else signal.in_unit(FIRST[id(rule.units)], factor)

    def _factor(self, part: str, units: Mapping[str, float], signal: Signal, where: str) -> float:
        """From a signal's unit to SI, by the map's word or else the DBC's."""
        given = self._map.units.get(part, self._map.units.get(where))
        text = signal.unit if given is None else given
        unit = unit_of(text, units)
        if unit is None:
            has = f"has the unit {text!r}" if given is None else f"is given the unit {text!r}"
            self._add(
                f"{part}: {where} {has}; give it one of {shown(units)} in the DBC or in drive.signals.units"
            )
            return 1.0
        if unit.rated:
            return unit.factor * self._rated(part, units, where)
        if not unit.electrical:
            return unit.factor
        if not self._map.pole_pairs:
            self._add(f"{part}: {where} counts electrical turns; that needs the motor's pole pairs")
        return unit.factor / (self._map.pole_pairs or 1)

    def _rated(self, part: str, units: Mapping[str, float], where: str) -> float:
        """The drive's rated value, which a value in per mille is of."""
        torque = units is DRIVE_TORQUE
        rated = self._map.rated_torque if torque else self._map.rated_current
        if rated is None:
            key = "rated_torque_n_m" if torque else "rated_current_arms"
            self._add(f"{part}: {where} is in per mille of the rated value; that needs drive.{key}")
        return rated or 1.0

    def _checked_plain(self, part: str, signal: Signal, where: str) -> Signal:
        """A signal that is a number of its own: an echo from 0 on, a raw state without a sign."""
        bare = (signal.scale, signal.offset, signal.is_float) == (1.0, 0.0, False)
        if part == "echo":
            if not bare or signal.signed:
                self._add(f"echo: {where} must be a plain unsigned number")
            return _from_zero(signal, self._first_count())
        if part == "enable":
            return self._checked_enable(signal, where)
        if part == "state" and self._map.states:
            if not bare:
                self._add(f"state: {where} must be a plain number")
            return replace(signal, signed=False, minimum=0.0, maximum=float((1 << signal.length) - 1))
        return signal

    def _checked_enable(self, signal: Signal, where: str) -> Signal:
        """The bit or number that enables, as 1 for on and 0 for off."""
        on, off = self._map.on_value, self._map.off_value
        if on == off:
            self._add(f"enable: on_value and off_value are both {on}; the drive could not be switched off")
            return signal
        if (on, off) == (1, 0):
            return signal
        low, high = signal.raw_range()
        for name, value in (("on_value", on), ("off_value", off)):
            if not low <= value <= high or signal.is_float:
                self._add(f"{name}: {value} does not fit {where}")
        scale, ends = 1.0 / (on - off), sorted((0.0, 1.0))
        return replace(signal, scale=scale, offset=-off * scale, minimum=ends[0], maximum=ends[1])

    def _first_count(self) -> int:
        """The number with which the command's counter begins; 0 where it can't be known."""
        name = self._lead()
        try:
            return self._database.message(name).signals[self._counters[name]].raw_range()[0]
        except (DatabaseError, KeyError):
            return 0

    def _checked_counter(self, message: Message) -> str:
        """The message's counter, checked for its place under its E2E profile; empty for none."""
        name = self._counters.get(message.name, "")
        place = _COUNTER_PLACE.get(message.profile)
        signal = message.signals.get(name)
        if name and signal is None:
            self._message(message.name, "counters", name)
            return ""
        if signal is None:
            if place is not None:
                self._add(f"counters: {message.name} has E2E profile {message.profile}; name its counter")
            return ""
        if (signal.scale, signal.offset, signal.signed, signal.is_float) != (1.0, 0.0, False, False):
            self._add(f"counters: {message.name}.{name} must be a plain unsigned number")
        elif signal.raw_count > MOST_COUNTS:
            self._add(
                f"counters: {message.name}.{name} has {signal.length} bits; at most 8 are used, or a range "
                f"of {MOST_COUNTS} numbers"
            )
        elif signal.raw_count < 2:
            self._add(f"counters: {message.name}.{name} has a range in which nothing can be counted")
        if place is not None and (signal.shift, signal.length) != place:
            self._add(
                f"counters: {message.name}.{name}: E2E profile {message.profile} has its counter in the "
                f"{place[1]} bits from bit {place[0]}"
            )
        return name

    def _check_cycles(self, received: set[str], others: tuple[Message | None, ...]) -> None:
        """A cycle time must be of a message that is heard."""
        known = received | {message.name for message in others if message is not None}
        for name in sorted(self._map.cycle_ms.keys() - known):
            self._add(
                f"cycle_ms: {name} is no message that is received; take one of {', '.join(sorted(known))}"
            )

    def _check_periods(self, incoming: list[Bound]) -> None:
        """Measurements must come as often as is said, by the DBC's cycle time where it has one."""
        for bound in incoming:
            measures = any(part in MEASURED for part, _ in bound.parts)
            cycle = bound.message.cycle_ms
            if measures and self._period_ms is not None and cycle > self._period_ms:
                self._add(
                    f"{bound.message.name} comes every {cycle:g} ms by the DBC, the loop counts on one every "
                    f"{self._period_ms:g} ms; write feedback.period_ms = {cycle:g}, lower loop.rate_hz, or, "
                    "where the drive is set to more, drive.signals.cycle_ms = "
                    f"{{ {bound.message.name} = {self._period_ms:g} }}"
                )

    def _check_shared(self, message: Message, names: Iterable[str]) -> None:
        """Each of what is read of one frame must have bits of its own."""
        seen = (1 << 8 * CRC_BYTES[message.profile]) - 1
        for name in dict.fromkeys(names):
            mask = message.signals[name].mask(message.length)
            if mask & seen:
                self._add(
                    f"{message.name}.{name} shares bits with another signal (overlapping); correct the DBC"
                )
            seen |= mask

    def _check_echo(self) -> None:
        """The echo counts as the command does, or it names the wrong command."""
        command = self._lead()
        if "echo" not in self._received or not command:
            return
        name, signal = self._received["echo"]
        counter = self._counters.get(command)
        if counter is None:
            self._add(f"echo: {command} has no counter to echo; name it in counters")
            return
        try:
            echo = self._database.message(name, signal).signals[signal]
            echoed = self._database.message(command, counter).signals[counter]
        except DatabaseError:
            return  # noted already
        if echo.length != echoed.length:
            self._add(f"echo: {name}.{signal} has {echo.length} bits, {command}.{counter} {echoed.length}")


def _from_zero(counter: Signal, first: int) -> Signal:
    """A counter that begins with ``first`` as one that begins with 0."""
    return replace(
        counter, offset=-float(first), minimum=counter.minimum - first, maximum=counter.maximum - first
    )
