"""One CiA 402 node asked, set and compared by SDO. It is never started and never enabled from here."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from drivers.bus import Link
from drivers.cia402 import (
    COB_IDS,
    MODE_SHOWN,
    MODES,
    OFF,
    OPTIONS,
    RPDO,
    SAVE,
    STATUSWORD,
    STORE,
    Entry,
    Pdo,
    Plan,
)
from drivers.eds import Dictionary, Place
from drivers.errors import DatabaseError, NodeError
from drivers.sdo import NMT, STORE_S, Sdo, named, shown
from drivers.states import of_statusword

PRE_OPERATIONAL: Final = 0x80
START: Final = 0x01
SYNC_ID, HEARTBEAT_ID = 0x080, 0x700
SHOWS_MODE_S: Final = 0.5
"""So long a drive may take until 6061h shows what 6060h asks for."""
_ENABLED: Final = (4, 5)
_FAULTS: Final = (6, 7)
_IDENTITY: Final = {1: "vendor", 2: "product", 3: "revision", 4: "serial"}
_SYNC, _SUPPORTED, _ERROR = 0x1005, 0x6502, 0x603F
_MAKES_SYNC, _COB_ID = 1 << 30, (1 << 30) - 1


@dataclass(frozen=True, slots=True)
class Held:
    """An object as it is wanted and as the node holds it."""

    entry: Entry
    found: int

    @property
    def ok(self) -> bool:
        """Are they the same?"""
        return self.entry.same(self.found)

    @property
    def wanted(self) -> int:
        """The value that is wanted, without a sign."""
        return self.entry.value & ((1 << 8 * self.entry.size) - 1)

    def words(self) -> str:
        """What is not as it should be, in one line."""
        entry = self.entry
        found, wanted = (hex(v) if entry.size == 4 else shown(v) for v in (self.found, self.wanted))
        return f"{entry.place} is {found}, not {wanted} ({entry.what})"


def pre_operational(link: Link, node_id: int) -> None:
    """Ask the node to leave its PDOs: mappings are changed in that state alone."""
    link.send(NMT, bytes((PRE_OPERATIONAL, node_id)))


def await_node(link: Link, node_id: int, seconds: float) -> None:
    """Wait until the node is heard, at most so long: one without a heartbeat is asked all the same."""
    end = time.monotonic_ns() + round(seconds * 1e9)
    while (left := end - time.monotonic_ns()) > 0:
        frame = link.receive(left)
        if frame is not None and frame.can_id | frame.flags == HEARTBEAT_ID + node_id:
            return


def other_controller(link: Link, node_id: int, seconds: float) -> int | None:
    """Listen for SYNC and for commands to this node: the identifier heard, or None."""
    theirs = {SYNC_ID, *(base + node_id for base in COB_IDS[RPDO])}
    end = time.monotonic_ns() + round(seconds * 1e9)
    while (left := end - time.monotonic_ns()) > 0:
        frame = link.receive(left)
        if frame is not None and frame.can_id | frame.flags in theirs:
            return frame.can_id
    return None


def identity(sdo: Sdo) -> dict[str, int]:
    """1018h as far as it is there."""
    count = sdo.read_int(0x1018)
    return {name: sdo.read_int(0x1018, sub) for sub, name in _IDENTITY.items() if sub <= count}


def refuse_other_device(sdo: Sdo, eds: Dictionary) -> None:
    """The node must be what the EDS is of, as far as its 1018h has numbers. Raises DatabaseError."""
    for sub, name in ((1, "vendor"), (2, "product")):
        one = eds.find(Place(0x1018, sub))
        expected = one.default if one is not None and isinstance(one.default, int) else 0
        if expected and (found := sdo.read_int(0x1018, sub)) != expected:
            raise DatabaseError(
                f"{eds.path}: is of {name} 0x{expected:X}, node {sdo.node_id} is 0x{found:X} (1018h:{sub}); "
                "take the drive's own EDS, or mend drive.node_id"
            )


def refuse_other_sync(sdo: Sdo) -> None:
    """SYNC is ours, and 80h: a node may not make it, which it would with a period in 1006h. Raises NodeError.

    1005h: the identifier, and bit 30 of a node that makes SYNC (CiA 301).
    """
    found = sdo.optional_int(_SYNC)
    if found is None or found & (_MAKES_SYNC | _COB_ID) == SYNC_ID:
        return
    wrong = "makes SYNC itself" if found & _MAKES_SYNC else "takes another frame as SYNC"
    raise NodeError(
        f"node {sdo.node_id} {wrong} (1005h = 0x{found:X}): nothing was changed; set its 1005h to "
        f"0x{SYNC_ID:X}: the controller sends SYNC"
    )


def refuse_running(sdo: Sdo) -> None:
    """A drive that is enabled is somebody's; one in fault would not be armed. Raises NodeError."""
    word = sdo.read_int(STATUSWORD)
    state = of_statusword(word)
    if state in _ENABLED:
        raise NodeError(
            f"node {sdo.node_id} is enabled (6041h = 0x{word:04X}): nothing was changed; disable it first"
        )


def fault_of(sdo: Sdo) -> int | None:
    """Error code of a drive in fault, None for one that is not."""
    return sdo.read_int(_ERROR) if of_statusword(sdo.read_int(STATUSWORD)) in _FAULTS else None


def refuse_mode(sdo: Sdo, mode: str) -> None:
    """The drive must have the mode by its 6502h, where it tells. Raises NodeError."""
    supported = sdo.optional_int(_SUPPORTED)
    if supported is not None and not supported >> (MODES[mode] - 1) & 1:
        has = [name for name, number in MODES.items() if supported >> (number - 1) & 1]
        raise NodeError(
            f"node {sdo.node_id} has no mode {mode} (6502h = 0x{supported:X}): "
            f"{'it has ' + ', '.join(has) if has else 'none of ' + ', '.join(MODES)}; set canopen.mode"
        )


def write(sdo: Sdo, plan: Plan) -> None:
    """Set all of it, in the standard's order. Raises NodeError with the object that is refused."""
    for entry in plan.given:
        _set(sdo, entry)
    for pdo in plan.pdos:
        _write_pdo(sdo, pdo, pdo.map_index in plan.fixed)
    for entry in plan.silent:
        _switch_off(sdo, entry.place.index)
    for entry in plan.rest:
        _set(sdo, entry)


def _set(sdo: Sdo, entry: Entry) -> None:
    sdo.write(entry.place.index, entry.place.sub, entry.value, entry.size)


def _switch_off(sdo: Sdo, index: int) -> None:
    sdo.write(index, 1, sdo.read_int(index, 1) | OFF, 4)


def _write_pdo(sdo: Sdo, pdo: Pdo, fixed: bool) -> None:
    """Off, no entries, entries, their number, transmission, on. A mapping that is fixed is only compared."""
    _switch_off(sdo, pdo.index)
    if not fixed:
        sdo.write(pdo.map_index, 0, 0, 1)
        for entry in pdo.entries:
            _set(sdo, entry)
        sdo.write(pdo.map_index, 0, len(pdo.entries), 1)
    cob_id, transmission = pdo.on()
    _set(sdo, transmission)
    if pdo.timer:
        _set(sdo, pdo.timer)
    held = sdo.read_int(pdo.index, 1)
    sdo.write(pdo.index, 1, cob_id.value | held & cob_id.free, 4)


def compare(sdo: Sdo, plan: Plan) -> Iterator[Held]:
    """Each object of the plan as the node holds it now."""
    for entry in plan.wanted():
        yield Held(entry, sdo.read_int(entry.place.index, entry.place.sub))


def confirm_mode(sdo: Sdo, mode: str) -> None:
    """Wait until 6061h shows the mode. Raises NodeError when it does not."""
    end = time.monotonic_ns() + round(SHOWS_MODE_S * 1e9)
    while (found := sdo.read_int(MODE_SHOWN, signed=True)) != MODES[mode]:
        if time.monotonic_ns() > end:
            other = next((name for name, number in MODES.items() if number == found), "")
            raise NodeError(
                f"node {sdo.node_id} does not confirm mode {mode}: {named(MODE_SHOWN)} shows {found}"
                f"{f' ({other})' if other else ''}, not {MODES[mode]}; does the drive have this mode, and "
                "is it free to change?"
            )
        time.sleep(0.01)


@dataclass(frozen=True, slots=True)
class Option:
    """How the drive stops by itself in one case; it is only read."""

    what: str
    place: Place
    code: int
    text: str


def options(sdo: Sdo) -> list[Option]:
    """All option codes that the drive has."""
    codes = {index: sdo.optional_int(index, signed=True) for index in OPTIONS}
    return [
        Option(OPTIONS[index][0], Place(index), code, OPTIONS[index][1].get(code, "its maker knows"))
        for index, code in codes.items()
        if code is not None
    ]


def store(sdo: Sdo) -> None:
    """Save all parameters into the node's non-volatile memory (1010h:1)."""
    sdo.write(STORE, 1, SAVE, 4, STORE_S)
