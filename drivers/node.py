"""How identifiers of a DBC move to another node: CANopen's ranges, or a rule of the drive's own."""

from __future__ import annotations

import re
from typing import Final

from drivers.errors import DatabaseError

CANOPEN_NODES: Final = range(1, 128)
_FOR_ALL: Final = (0x000, 0x080, 0x100)  # NMT, SYNC, TIME
_OF_A_NODE: Final = frozenset(
    (0x080, 0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x480, 0x500, 0x580, 0x600, 0x700)
)  # EMCY, PDOs, SDO, heartbeat: CiA 301, predefined connection set
_RULE: Final = re.compile(r"id\s*<<\s*(\d+)(?:\s*:\s*(\d+))?")
MOTEUS: Final = "moteus"
_ASKED: Final = 0x8000
"""Of a moteus identifier: the frame is to be answered, so it goes to the drive."""


class NodeRule:
    """Where a node's number stands in an identifier. Raises DatabaseError for a rule that is none.

    Without a rule CANopen's: identifiers of the file's node 1 in the predefined connection set move, those
    for all nodes stay. ``id << 5`` puts the number above the low five bits; ``id << 0 : 8`` into so many.
    ``moteus``: source << 8 | destination, so the number is the low seven bits of what is to be answered, and
    bits 8 to 14 of an answer.
    """

    def __init__(self, node_id: int = 1, rule: str = "") -> None:
        self.node_id, self.rule = node_id, rule
        found = _RULE.fullmatch(rule.strip()) if rule else None
        if rule and found is None and rule != MOTEUS:
            raise DatabaseError(
                f'node_rule = "{rule}": write "id << 5", "id << 0 : 8" for so many bits, or "{MOTEUS}"'
            )
        if rule == MOTEUS and node_id not in CANOPEN_NODES:
            raise DatabaseError(f"node_id = {node_id}: a moteus has one of 1 to 127")
        if not rule and node_id not in CANOPEN_NODES:
            raise DatabaseError(
                f"node_id = {node_id}: CANopen has the nodes 1 to 127; others need a node_rule"
            )
        self._shift = int(found[1]) if found else 0
        self._width = int(found[2] or 0) if found else 0

    def moved(self, can_id: int, extended: bool) -> tuple[int, bool]:
        """The identifier for this node, and whether it is one that a node's number does not move."""
        if self.rule == MOTEUS:
            shift = 0 if can_id & _ASKED else 8
            return can_id & ~(0x7F << shift) | self.node_id << shift, False
        if self.rule:
            return self._ruled(can_id, extended), False
        if extended or can_id & ~0x7F not in _OF_A_NODE or can_id & 0x7F != 1:
            return can_id, not (not extended and can_id in _FOR_ALL)
        return can_id - 1 + self.node_id, False

    def _ruled(self, can_id: int, extended: bool) -> int:
        width = self._width or max((29 if extended else 11) - self._shift, 0)
        if self._shift + width > (29 if extended else 11) or self.node_id >= 1 << width:
            raise DatabaseError(
                f'node_rule = "{self.rule}": {self.node_id} does not fit into identifier 0x{can_id:X}'
            )
        field = ((1 << width) - 1) << self._shift
        return can_id & ~field | self.node_id << self._shift
