"""A drive map bound to a DBC: the messages to read and to write, checked whole before anything is sent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from drivers.codec import Database, Message
from drivers.errors import DatabaseError, EncodeError
from drivers.mapping import MEASURED, RECEIVED, SENT, STATES, STATUSWORD, DriveMap, Part
from drivers.signal import Signal

_COUNTER_PLACE = {2: (8, 4), 5: (16, 8)}


@dataclass(frozen=True, slots=True)
class Bound:
    """One message of the map: its counter (may be empty) and (part, signal) pairs, in SI units."""

    message: Message
    counter: str
    parts: tuple[tuple[str, str], ...]
    constants: tuple[tuple[str, float], ...] = ()

    @property
    def counter_modulus(self) -> int:
        """Number of values of this message's counter; 256 when it has none."""
        return 1 << self.message.signals[self.counter].length if self.counter else 256


@dataclass(frozen=True, slots=True)
class Binding:
    """The map's messages: to read, and to write in this order (the one with u_q last)."""

    map: DriveMap
    incoming: tuple[Bound, ...]
    outgoing: tuple[Bound, ...]
    sync: Message | None
    emergency: Message | None
    heartbeat: Message | None
    factors: Mapping[str, float] = field(default_factory=dict)
    """From the DBC's unit of each part to SI, where they differ."""

    def signal(self, part: str) -> Signal | None:
        """The signal of a part, in SI units; None when the drive has none."""
        for bound in self.incoming + self.outgoing:
            for name, signal in bound.parts:
                if name == part:
                    return bound.message.signals[signal]
        return None

    @property
    def counters(self) -> dict[str, str]:
        """The counter of each message that has one, by message name."""
        bounds = self.incoming + self.outgoing
        return {bound.message.name: bound.counter for bound in bounds if bound.counter}

    @property
    def command(self) -> Bound:
        """The message with u_q."""
        return self.outgoing[-1]

    @property
    def counter_modulus(self) -> int:
        """Number of values of the command's counter, as echoed."""
        return self.command.counter_modulus


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
        self._counters = dict(self._pairs("counters", drive.counters))
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

    def _places(self, parts: dict[str, Part], skipped: tuple[str, ...]) -> dict[str, tuple[str, str]]:
        """(message, signal) of each part that the map has."""
        named = {part: getattr(self._map, part) for part in parts if part not in skipped}
        return {part: pair for part, text in named.items() if text for pair in self._pairs(part, (text,))}

    def bind(self) -> Binding:
        """Return the binding or raise with all mistakes."""
        incoming = self._bounds(self._received, RECEIVED)
        outgoing = self._bounds(self._sent, SENT)
        last = self._sent.get("u_q", ("", ""))[0]
        outgoing.sort(key=lambda bound: bound.message.name == last)
        sync, emergency, heartbeat = (
            self._message(getattr(self._map, name), name) for name in ("sync", "emergency", "heartbeat")
        )
        self._check_whole()
        self._check_periods(incoming)
        self._check_zero(outgoing)
        if self._mistakes:
            raise DatabaseError(f"{self._database.path}: " + "; ".join(self._mistakes))
        ins, outs = tuple(incoming), tuple(outgoing)
        return Binding(self._map, ins, outs, sync, emergency, heartbeat, self._factors)

    def _message(self, name: str, part: str, *signals: str) -> Message | None:
        """The message, or None with the mistake noted."""
        if not name:
            return None
        try:
            return self._database.message(name, *signals)
        except DatabaseError as error:
            self._add(f"{part}: {str(error).removeprefix(f'{self._database.path}: ')}")
            return None

    def _bounds(self, places: dict[str, tuple[str, str]], parts: dict[str, Part]) -> list[Bound]:
        """One bound message for each that the places name."""
        by_message: dict[str, dict[str, str]] = {}
        for part, (name, signal) in places.items():
            if self._message(name, part, signal) is not None:
                by_message.setdefault(name, {})[part] = signal
        constants = self._constants(by_message) if parts is SENT else {}
        return [
            self._bound(name, signals, parts, tuple(constants.get(name, ())))
            for name, signals in by_message.items()
        ]

    def _constants(self, by_message: dict[str, dict[str, str]]) -> dict[str, list[tuple[str, float]]]:
        out: dict[str, list[tuple[str, float]]] = {}
        for text, value in self._map.constants.items():
            for name, signal in self._pairs("constants", (text,)):
                if name not in by_message:
                    self._add(f'constants: "{text}": {name} is no message of the command')
                elif self._message(name, "constants", signal) is not None:
                    out.setdefault(name, []).append((signal, value))
        return out

    def _bound(
        self,
        name: str,
        signals: dict[str, str],
        parts: dict[str, Part],
        constants: tuple[tuple[str, float], ...],
    ) -> Bound:
        message = self._database.message(name)
        converted = {
            signal: self._checked(part, parts[part], message.signals[signal], f"{name}.{signal}")
            for part, signal in signals.items()
        }
        counter = self._checked_counter(message)
        return Bound(message.with_signals(converted), counter, tuple(signals.items()), constants)

    def _checked(self, part: str, rule: Part, signal: Signal, where: str) -> Signal:
        """The signal in SI units; unit and range are checked."""
        if rule.signed and not signal.minimum < 0.0 < signal.maximum:
            low, high = f"{signal.minimum:g}", f"{signal.maximum:g}"
            self._add(f"{part}: {where} has the range {low} .. {high}; it must reach below and above 0")
        if not rule.units:
            return signal
        if signal.unit not in rule.units:
            known = ", ".join(rule.units)
            self._add(f"{part}: {where} has the unit {signal.unit!r}; give it one of {known} in the DBC")
            return signal
        factor = self._factors[part] = rule.units[signal.unit]
        return signal if factor == 1.0 else signal.in_unit(next(iter(rule.units)), factor)

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
        if signal.length > 8:
            self._add(f"counters: {message.name}.{name} has {signal.length} bits; at most 8 are used")
        if place is not None and (signal.shift, signal.length) != place:
            self._add(
                f"counters: {message.name}.{name}: E2E profile {message.profile} has its counter in the "
                f"{place[1]} bits from bit {place[0]}"
            )
        return name

    def _check_whole(self) -> None:
        """What concerns more than one signal."""
        missing = [part for part in (*MEASURED, "state", "u_q", "u_d") if not getattr(self._map, part)]
        for part in missing:
            self._add(f'{part}: missing; name it as "MESSAGE.Signal"')
        if not (self._map.controlword or self._map.enable):
            self._add("controlword or enable: one of them must be named, or the drive can't be switched off")
        both = {name for name, _ in self._received.values()} & {name for name, _ in self._sent.values()}
        for name in sorted(both):
            self._add(f"{name} is both received and sent; a frame has one sender")
        for message in self._counters:
            if not any(message == name for name, _ in (*self._received.values(), *self._all_sent())):
                self._add(f"counters: {message} is no message of this map")
        self._check_states()
        self._check_echo()

    def _all_sent(self) -> Iterator[tuple[str, str]]:
        return self._pairs("load", tuple(filter(None, (getattr(self._map, part) for part in SENT))))

    def _check_states(self) -> None:
        states = self._map.states
        if isinstance(states, str):
            if states != STATUSWORD:
                self._add(f'states = "{states}": a table of raw value = name, or "{STATUSWORD}"')
            return
        for raw, name in states.items():
            if name not in STATES:
                self._add(f'states: {raw} = "{name}"; known are {", ".join(STATES)}')
        if states and "operation enabled" not in states.values():
            self._add('states: no value is "operation enabled"; the drive could never be seen running')

    def _check_echo(self) -> None:
        """The echo counts as the command does, or it names the wrong command."""
        if "echo" not in self._received or "u_q" not in self._sent:
            return
        name, signal = self._received["echo"]
        command = self._sent["u_q"][0]
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

    def _check_periods(self, incoming: list[Bound]) -> None:
        """Measurements must come at least once a period, by the DBC's cycle time where it has one."""
        for bound in incoming:
            measures = any(part in MEASURED for part, _ in bound.parts)
            cycle = bound.message.cycle_ms
            if measures and self._period_ms is not None and cycle > self._period_ms:
                self._add(
                    f"{bound.message.name} comes every {cycle} ms by the DBC, the loop runs every "
                    f"{self._period_ms:g} ms; lower loop.rate_hz"
                )

    def _check_zero(self, outgoing: list[Bound]) -> None:
        """Zero and every constant can be sent: stopping must never fail on a range."""
        for bound in outgoing:
            wanted = {signal: 0.0 for _, signal in bound.parts} | dict(bound.constants)
            for signal, value in wanted.items():
                one = bound.message.signals[signal]
                try:
                    exact = abs(one.to_phys(one.to_bits(value)) - value) <= abs(one.scale) * 1e-6
                    problem = "" if exact else f"{value:g} is between two steps"
                except EncodeError as error:
                    problem = str(error)
                if problem:
                    self._add(f"{bound.message.name}.{signal}: {value:g} can't be sent: {problem}")
