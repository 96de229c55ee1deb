"""The object dictionary of the emulated CANopen node: its EDS, what was written to it, and what may be.

The `canopen` library's LocalNode keeps the values and serves SDO; the rules of CiA 301 for PDOs are here,
since it has none. Nothing of this is shared with the controller's side.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import canopen
from canopen.objectdictionary import datatypes

NOT_THERE, NO_MAPPING, TOO_LONG = 0x06020000, 0x06040041, 0x06040042
OUT_OF_RANGE, NOT_STORED, WRONG_STATE = 0x06090030, 0x08000020, 0x08000022
"""SDO abort codes of CiA 301."""
OFF: Final = 1 << 31
RPDOS, TPDOS = (0x1400, 0x1401), (0x1800, 0x1801)
_MAPS: Final = 0x200
"""A PDO's mapping object stands so far behind its communication object."""
_PARAMETERS: Final = range(0x1400, 0x1C00)
_SAVE: Final = b"save"
_MODES: Final = (8, 9, 10)
_QUICK_STOPS: Final = (0, 2, 6)
_ALLOWED: Final = {
    0x6007: (0, 1, 2, 3), 0x6060: (0, *_MODES), 0x605A: _QUICK_STOPS, 0x605E: (0,),
}  # fmt: skip
"""Values that this drive knows what to do with."""
_SIGNED: Final = datatypes.SIGNED_TYPES
_PASSING: Final = (0x1010, 0x6040, 0x6071, 0x607A, 0x60FF)
"""What a save leaves out: commands."""
Sent = tuple[int, bytes, bool]


class Mapped(NamedTuple):
    """An object in a PDO."""

    at: int
    sub: int
    size: int
    signed: bool


class Refusal(canopen.SdoAbortedError):  # type: ignore[misc]  # its type is not read
    """A write that is refused with an abort code."""


class _Wire:
    """What the library's node needs of a network: frames are kept until they are sent, by no thread."""

    def __init__(self) -> None:
        self.due: list[Sent] = []

    def subscribe(self, can_id: int, callback: Callable[..., None]) -> None:
        """Frames are handed over by :meth:`Objects.request`."""

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Keep a frame."""
        self.due.append((can_id, bytes(data), False))

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Any:
        """The heartbeat, which the node sends by its own clock."""
        return self

    def stop(self) -> None:
        """End of what was never begun."""

    def update(self, data: bytes) -> None:
        """New content of what the node sends itself."""


class Objects:
    """Values by index and sub-index. ``live``: what is asked of the drive; ``written`` is told of each write.

    ``stored`` survives a loss of supply: what was saved by 1010h.
    """

    def __init__(
        self,
        eds: Path,
        node_id: int,
        stored: dict[int, dict[int, bytes]],
        live: Callable[[int], int | None],
        written: Callable[[int], None],
    ) -> None:
        self._wire, self._stored, self._written = _Wire(), stored, written
        self._touched: list[int] = []
        self._node: Any = canopen.LocalNode(node_id, canopen.import_od(str(eds), node_id))
        self._node.associate_network(self._wire)
        self._live = live
        self._brought: dict[tuple[int, int], int] = {}
        self._known: dict[tuple[int, int], int] = {}
        self._node.add_read_callback(self._now)
        self._node.add_write_callback(self._check)
        self.operational = False
        self._request = 0x600 + node_id
        self.restart()

    def restart(self) -> None:
        """What a node has after power-on: what was stored, else its defaults."""
        self._brought.clear()
        self._known.clear()
        self._node.data_store.clear()
        self._node.data_store.update({index: dict(subs) for index, subs in self._stored.items()})

    @property
    def due(self) -> list[Sent]:
        """Frames to be sent, taken from here."""
        due, self._wire.due = self._wire.due, []
        return due

    def request(self, can_id: int, data: bytes) -> bool:
        """Serve an SDO request; False for a frame that is none."""
        if can_id != self._request or len(data) != 8:
            return False
        self._touched.clear()
        self._known.clear()
        self._node.sdo.on_request(can_id, bytearray(data), 0.0)
        for index in self._touched:
            self._written(index)
        return True

    def get(self, index: int, sub: int = 0) -> int:
        """A whole number, as it is read by SDO."""
        now = self._now(index, sub)
        if now is not None:
            return now
        value = self._known.get((index, sub))
        if value is None:
            raw = self._node.get_data(index, sub)
            value = self._known[index, sub] = int(self._one(index, sub).decode_raw(raw))
        return value

    def put(self, index: int, value: int, sub: int = 0) -> None:
        """Set what a PDO has brought."""
        self._brought[index, sub] = value

    def _now(self, index: int, subindex: int, od: Any = None) -> int | None:
        """What a PDO has brought, or the drive measures."""
        brought = self._brought.get((index, subindex))
        return self._live(index) if brought is None and not subindex else brought

    def _one(self, index: int, sub: int) -> Any:
        return self._node.object_dictionary.get_variable(index, sub)

    def mapping(self, communication: int) -> tuple[Mapped, ...]:
        """The objects that a PDO carries."""
        at = communication + _MAPS
        return tuple(self._mapped(self.get(at, k)) for k in range(1, self.get(at) + 1))

    def _mapped(self, entry: int) -> Mapped:
        index, sub, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        one = self._one(index, sub)
        if one is None:
            raise Refusal(NOT_THERE)
        if not one.pdo_mappable or len(one) != bits or bits % 8:
            raise Refusal(NO_MAPPING)
        return Mapped(index, sub, bits // 8, one.data_type in _SIGNED)

    def _check(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        """Refuse what may not be written now, and act on what is more than a value. Raises Refusal."""
        value = int.from_bytes(data, "little", signed=od.data_type in _SIGNED)
        if index in _ALLOWED and value not in _ALLOWED[index]:
            raise Refusal(OUT_OF_RANGE)
        if index in _PARAMETERS:
            self._check_pdo(index, subindex, value)
        if (index, subindex) == (0x1010, 1):
            self._store(bytes(data))
        self._brought.pop((index, subindex), None)
        self._touched.append(index)

    def _check_pdo(self, index: int, sub: int, value: int) -> None:
        if self.operational:
            raise Refusal(WRONG_STATE)
        if index & 0x200:
            self._check_mapping(index, sub, value)
        elif sub == 1:
            held = self.get(index, 1)
            if not (held | value) & OFF and (held ^ value) & 0x1FFFFFFF:
                raise Refusal(WRONG_STATE)
        elif sub == 2 and 241 <= value <= 253:
            raise Refusal(OUT_OF_RANGE)

    def _check_mapping(self, index: int, sub: int, value: int) -> None:
        """A mapping is changed with its PDO off, an entry while none counts; their number is checked last."""
        if not self.get(index - _MAPS, 1) & OFF or (sub and self.get(index)):
            raise Refusal(WRONG_STATE)
        if sub:
            self._mapped(value)
        elif value:
            if value > 4:
                raise Refusal(TOO_LONG)
            if sum(self._mapped(self.get(index, k)).size for k in range(1, value + 1)) > 8:
                raise Refusal(TOO_LONG)

    def _store(self, data: bytes) -> None:
        if data != _SAVE:
            raise Refusal(NOT_STORED)
        self._stored.clear()
        kept = self._node.data_store.items()
        self._stored.update({index: dict(subs) for index, subs in kept if index not in _PASSING})
