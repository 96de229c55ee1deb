"""What a CiA 402 drive is set to: mode, PDOs on SYNC, interpolation time, heartbeat, object by object.

CiA 301 changes a PDO in this order: off (bit 31 of its COB-ID), no entries, the entries, their number, its
transmission, on. Everything else of a drive stays as its maker or its own tool has set it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from drivers.eds import Dictionary, Place, is_signed
from drivers.errors import DatabaseError
from drivers.sdo import named

MODES: Final = {"csp": 8, "csv": 9, "cst": 10}
"""Cyclic synchronous position, velocity, torque: 6060h."""
RPDO, RPDO_MAP, TPDO, TPDO_MAP = 0x1400, 0x1600, 0x1800, 0x1A00
OFF: Final = 1 << 31
NO_RTR: Final = 1 << 30
"""Bits of a COB-ID: the PDO is off; no remote frame asks for it, which is the node's own affair."""
COB_IDS: Final = {RPDO: (0x200, 0x300, 0x400, 0x500), TPDO: (0x180, 0x280, 0x380, 0x480)}
"""The predefined connection set: identifiers of PDO 1 to 4, to which the node's number is added."""
EVERY_SYNC: Final = 1
MOST_SYNCS: Final = 240
"""Transmission types 1 to 240: with every SYNC, or every so many."""
MODE, MODE_SHOWN, STATUSWORD, CONTROLWORD = 0x6060, 0x6061, 0x6041, 0x6040
INTERPOLATION, HEARTBEAT, SYNC_PERIOD, SYNC_COUNT, STORE = 0x60C2, 0x1017, 0x1006, 0x1019, 0x1010
SAVE: Final = int.from_bytes(b"save", "little")
_TARGET: Final = {"csp": 0x607A, "csv": 0x60FF, "cst": 0x6071}
_ANSWER: Final = {
    "csp": ((0x6041, 0x6064, 0x6077), (0x606C,)),
    "csv": ((0x6041, 0x606C, 0x6077),),
    "cst": ((0x6041, 0x606C, 0x6077),),
}
NAMES: Final = {
    0x603F: "ErrorCode", 0x6040: "Controlword", 0x6041: "Statusword", 0x6060: "Mode", 0x6061: "ModeShown",
    0x6064: "Position", 0x606B: "VelocityDemand", 0x606C: "Velocity", 0x6071: "TargetTorque",
    0x6074: "TorqueDemand", 0x6077: "Torque", 0x6078: "Current", 0x6079: "DcLinkVoltage",
    0x607A: "TargetPosition", 0x60B1: "VelocityOffset", 0x60B2: "TorqueOffset", 0x60F4: "FollowingError",
    0x60FD: "DigitalInputs", 0x60FE: "DigitalOutputs", 0x60FF: "TargetVelocity",
}  # fmt: skip
"""Names of CiA 402's objects as signals; all others have the EDS's."""
OPTIONS: Final = {
    0x6007: ("connection_lost", {0: "no action", 1: "fault", 2: "voltage off", 3: "quick stop"}),
    0x605A: (
        "quick_stop",
        {0: "voltage off", 1: "slow-down ramp", 2: "quick-stop ramp", 3: "current limit", 4: "voltage limit"}
        | {5: "slow-down ramp, stays", 6: "quick-stop ramp, stays", 7: "current limit, stays"}
        | {8: "voltage limit, stays"},
    ),
    0x605B: ("shutdown", {0: "voltage off", 1: "slow-down ramp"}),
    0x605C: ("disable_operation", {0: "voltage off", 1: "slow-down ramp"}),
    0x605E: (
        "fault_reaction",
        {0: "voltage off", 1: "slow-down ramp", 2: "quick-stop ramp", 3: "current limit", 4: "voltage limit"},
    ),
}
"""Option codes that say how the drive stops by itself: only read and shown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What is asked of a node. Empty ``rpdo`` and ``tpdo``: the mode's own."""

    mode: str
    period_ns: int
    heartbeat_ms: int
    rpdo: tuple[tuple[Place, ...], ...] = ()
    tpdo: tuple[tuple[Place, ...], ...] = ()
    sync_period: bool = False
    rpdo_timeout_ms: int | None = None
    every: int = 1
    """SYNCs from one answer of the node to the next."""


class Entry(NamedTuple):
    """An object, its value and bytes, what it is for, and bits in which it need not be the same."""

    place: Place
    value: int
    size: int
    what: str
    free: int = 0

    def same(self, found: int) -> bool:
        """Does the node hold this value?"""
        return (found ^ self.value) & ~self.free & ((1 << 8 * self.size) - 1) == 0


class Mapped(NamedTuple):
    """An object in a PDO: its first bit there and its length."""

    place: Place
    bit: int
    length: int
    signed: bool
    name: str


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO: its communication and mapping objects, its identifier, what it carries."""

    index: int
    map_index: int
    name: str
    cob_id: int
    objects: tuple[Mapped, ...]
    entries: tuple[Entry, ...]
    timer: Entry | None = None
    every: int = EVERY_SYNC

    @property
    def sent(self) -> bool:
        """True for one that the controller sends."""
        return self.index < TPDO

    @property
    def length(self) -> int:
        """Bytes of its frame."""
        return sum(one.length for one in self.objects) // 8

    def on(self) -> tuple[Entry, Entry]:
        """Its identifier and that it goes with every SYNC, or every so many."""
        where = f"{self.name} on 0x{self.cob_id:X}"
        each = "every SYNC" if self.every == EVERY_SYNC else f"every {self.every}th SYNC"
        return (
            Entry(Place(self.index, 1), self.cob_id, 4, where, NO_RTR),
            Entry(Place(self.index, 2), self.every, 1, f"{self.name} with {each}"),
        )

    def wanted(self) -> Iterator[Entry]:
        """Every object of it, as it must be found."""
        yield from self.on()
        yield from (self.timer,) if self.timer else ()
        count = len(self.objects)
        yield Entry(Place(self.map_index), count, 1, f"{self.name} carries {count} objects")
        yield from self.entries


@dataclass(frozen=True, slots=True)
class Plan:
    """All that a node is set to: a DCF's own values, PDOs, PDOs that must be off, and the rest."""

    given: tuple[Entry, ...]
    pdos: tuple[Pdo, ...]
    silent: tuple[Entry, ...]
    rest: tuple[Entry, ...]
    mode: str
    fixed: frozenset[int] = field(default_factory=frozenset)
    """Mapping objects that can't be written."""

    def wanted(self) -> Iterator[Entry]:
        """Every object with the value that must be found there."""
        yield from self.given
        for pdo in self.pdos:
            yield from pdo.wanted()
        yield from self.silent
        yield from self.rest


def plan_of(eds: Dictionary, node_id: int, wish: Wish) -> Plan:
    """The plan of a node. Raises DatabaseError that names each object that can't do it."""
    maker = _Maker(eds, node_id, wish)
    made = maker.plan()
    if maker.mistakes:
        raise DatabaseError("\n".join(dict.fromkeys(maker.mistakes)))
    return made


class _Maker:
    """Collects mistakes while it plans."""

    def __init__(self, eds: Dictionary, node_id: int, wish: Wish) -> None:
        self._eds, self._node_id, self._wish = eds, node_id, wish
        self.mistakes: list[str] = []

    def plan(self) -> Plan:
        wish, mode = self._wish, self._wish.mode
        sent = wish.rpdo or ((Place(CONTROLWORD), Place(_TARGET[mode])),)
        heard = wish.tpdo or tuple(tuple(map(Place, row)) for row in _ANSWER[mode])
        pdos = (*self._pdos(RPDO, RPDO_MAP, sent), *self._pdos(TPDO, TPDO_MAP, heard))
        fixed = frozenset(pdo.map_index for pdo in pdos if not self._writable(Place(pdo.map_index)))
        rest = (*self._rest(),)
        own = {entry.place for entry in rest} | {Place(STORE, 1), Place(CONTROLWORD), Place(_TARGET[mode])}
        given = tuple(
            Entry(place, value, size, self._eds.name(place))
            for place, value, size in self._eds.configured()
            if place not in own
        )
        self._must_have(sent, CONTROLWORD, "rpdo")
        self._must_have(heard, STATUSWORD, "tpdo")
        return Plan(given, pdos, (*self._silent(len(sent), len(heard)),), rest, mode, fixed)

    def _must_have(self, rows: tuple[tuple[Place, ...], ...], index: int, what: str) -> None:
        if all(Place(index) not in row for row in rows):
            self.mistakes.append(
                f"canopen.{what}: {named(index)} is in none of them; without {NAMES[index].lower()} no drive "
                "can be switched off, or seen to be"
            )

    def _writable(self, place: Place) -> bool:
        found = self._eds.find(place)
        return found is not None and bool(found.writable)

    def _pdos(self, base: int, maps: int, rows: tuple[tuple[Place, ...], ...]) -> Iterator[Pdo]:
        for number, places in enumerate(rows):
            try:
                yield self._pdo(base, maps, number, places)
            except DatabaseError as error:
                self.mistakes.append(str(error))

    def _pdo(self, base: int, maps: int, number: int, places: tuple[Place, ...]) -> Pdo:
        """One PDO with the bits of its objects."""
        sent, name = base == RPDO, f"{'RPDO' if base == RPDO else 'TPDO'}{number + 1}"
        if number >= len(COB_IDS[base]):
            raise DatabaseError(f"canopen: {name}: the predefined connection set has four of them")
        for place in (Place(base + number, 1), Place(base + number, 2), Place(maps + number)):
            self._eds.number(place, name)
        objects, bit = [], 0
        for place in places:
            one = self._eds.mapped(place, name, sent=sent)
            called = NAMES.get(place.index, "") if not place.sub else ""
            objects.append(Mapped(place, bit, len(one), is_signed(one), called or _plain(one.name)))
            bit += len(one)
        if bit > 64:
            raise DatabaseError(f"canopen: {name} would have {bit // 8} bytes; a frame has 8: split it")
        entries = tuple(
            Entry(Place(maps + number, k), one.place.index << 16 | one.place.sub << 8 | one.length, 4,
                  f"{name} carries {one.place} {one.name}")
            for k, one in enumerate(objects, 1)
        )  # fmt: skip
        cob_id, every = (
            COB_IDS[base][number] + self._node_id,
            EVERY_SYNC if base == RPDO else self._wish.every,
        )
        timer = self._timer(base, number)
        return Pdo(base + number, maps + number, name, cob_id, tuple(objects), entries, timer, every)

    def _timer(self, base: int, number: int) -> Entry | None:
        """The deadline of the first RPDO: the drive's own watchdog of commands."""
        wanted = self._wish.rpdo_timeout_ms
        if base != RPDO or number or wanted is None:
            return None
        self._eds.number(Place(RPDO, 5), "deadline of the command, canopen.rpdo_timeout_ms")
        return Entry(Place(RPDO, 5), wanted, 2, "RPDO1 must come within [ms]")

    def _silent(self, sent: int, heard: int) -> Iterator[Entry]:
        """PDOs of the connection set that this plan does not use: nobody should load the bus, or command."""
        for base, used in ((RPDO, sent), (TPDO, heard)):
            for number in range(used, len(COB_IDS[base])):
                if self._writable(Place(base + number, 1)):
                    name = f"{'RPDO' if base == RPDO else 'TPDO'}{number + 1}"
                    yield Entry(Place(base + number, 1), OFF, 4, f"{name} off", OFF - 1)

    def _rest(self) -> Iterator[Entry]:
        wish = self._wish
        for place, value, what, needed in (
            (Place(INTERPOLATION, 1), *self._interpolation(0), True),
            (Place(INTERPOLATION, 2), *self._interpolation(1), True),
            (Place(MODE), MODES[wish.mode], f"mode {wish.mode}", True),
            (Place(HEARTBEAT), wish.heartbeat_ms, "heartbeat every [ms]", True),
            (Place(SYNC_COUNT), 0, "SYNC without a counter", False),
            (Place(SYNC_PERIOD), wish.period_ns // 1000, "SYNC every [us]", wish.sync_period),
        ):
            if place.index == SYNC_PERIOD and not wish.sync_period:
                continue
            if needed or self._eds.has(place.index, place.sub):
                try:
                    size = len(self._eds.number(place, what)) // 8
                    yield Entry(place, value, size, what)
                except DatabaseError as error:
                    self.mistakes.append(str(error))
        if wish.sync_period and wish.period_ns % 1000:
            self.mistakes.append(f"canopen.sync_period: {wish.period_ns} ns are no whole microseconds")
        if not self._eds.has(MODE_SHOWN):
            self.mistakes.append(
                f"{self._eds.path}: has no object {named(MODE_SHOWN)} (the mode that the drive confirms)"
            )

    def _interpolation(self, part: int) -> tuple[int, str]:
        """60C2h: the period as value times 10^index s."""
        value, exponent = self._wish.period_ns, -9
        while value % 10 == 0:
            value, exponent = value // 10, exponent + 1
        if value > 255:
            self.mistakes.append(
                f"loop.rate_hz: a period of {self._wish.period_ns} ns can't be said in 60C2h (1 to 255 "
                "times a power of ten); take 1000, 2000, 4000, 5000 Hz or the like"
            )
        return ((value, "period, its value"), (exponent, "period, its power of ten [s]"))[part]


def _plain(name: str) -> str:
    """An EDS's name as a signal's."""
    words = "".join(c if c.isascii() and c.isalnum() else " " for c in name).split()
    text = "".join(word[:1].upper() + word[1:] for word in words)[:32] or "Object"
    return text if text[0].isalpha() else f"O{text}"[:32]
