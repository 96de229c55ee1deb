"""Units of a CiA 402 drive's objects, as the drive tells them: rated torque and current, unit of speed.

    torque  = raw / 1000 * 6076h [mN m]      current = raw / 1000 * 6075h [mA]
    speed   = raw * (unit in 60A9h), CiA 303-2: power of ten, numerator, denominator
    angle   = raw * (unit in 60A8h), or increments by 608Fh where no gear stands between (6091h)

Nothing is guessed: what the drive does not tell must stand in the config.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from drivers.errors import DatabaseError, NodeError
from drivers.sdo import Sdo
from drivers.units import ANGLE, SPEED, shown, unit_of

RATED_CURRENT, RATED_TORQUE, SPEED_UNIT = 0x6075, 0x6076, 0x60A9
RESOLUTION, GEAR, ANGLE_UNIT = 0x608F, 0x6091, 0x60A8
TORQUES: Final = (0x6071, 0x6072, 0x6074, 0x6077, 0x60B2, 0x60E0, 0x60E1)
CURRENTS: Final = (0x6073, 0x6078)
SPEEDS: Final = (0x606B, 0x606C, 0x60B1, 0x60FF)
ANGLES: Final = (0x6064,)
VOLTAGE: Final = 0x6079
_UNITS: Final = {
    (0xB4, 0x47): "rpm", (0xB4, 0x03): "rev/s", (0x10, 0x03): "rad/s", (0x41, 0x03): "deg/s",
}  # fmt: skip
"""CiA 303-2: revolutions, radians, degrees a minute or a second, by numerator and denominator."""
_ANGLES: Final = {0xB4: "rev", 0x10: "rad", 0x41: "deg"}
_CURRENT: Final = {"peak": "A", "rms": "Arms"}
_TEXT: Final = re.compile(r"\s*(?:(\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)(?:\s*/\s*(\d+))?\s+)?(\S.*)")


@dataclass(frozen=True, slots=True)
class Scale:
    """What a raw value is to be multiplied by, and the unit that makes."""

    factor: Fraction
    unit: str


@dataclass(frozen=True, slots=True)
class Said:
    """What the config says of units: of speed ("rpm", "0.001 rpm", "1/4096 rev/s"), of 6075h (rms, peak), of
    angle ("1/4096 rev").
    """

    velocity_unit: str = ""
    rated_current: str = ""
    position_unit: str = ""


def speed_scale(text: str, where: str, units: Mapping[str, float] = SPEED) -> Scale:
    """A unit of speed, or of ``units``, with a factor before it. Raises DatabaseError."""
    found, example = _TEXT.fullmatch(text), "rpm" if units is SPEED else "rev"
    if found is None or unit_of(found[3], units) is None or found[2] == "0":
        counted = "1/4096 rev/s" if units is SPEED else "1/4096 rev"
        raise DatabaseError(
            f'{where} = "{text}": give a unit of {shown(units)}, as "{example}" or "{counted}"'
        )
    return Scale(Fraction(found[1] or "1") / int(found[2] or 1), found[3])


def told_speed(raw: int) -> Scale | None:
    """The unit that 60A9h names; None for one in increments, or one that is unknown."""
    unit = _UNITS.get((raw >> 16 & 0xFF, raw >> 8 & 0xFF))
    power = (raw >> 24 ^ 0x80) - 0x80
    return Scale(Fraction(10) ** power, unit) if unit else None


class Scales:
    """Scale of each object, asked of the node once. Raises DatabaseError for what nobody says."""

    def __init__(self, sdo: Sdo, said: Said) -> None:
        self._sdo, self._said = sdo, said
        self._kept: dict[str, Scale | None] = {}
        self.told: dict[str, str] = {}
        """What the node said of them, in words."""

    def of(self, index: int) -> Scale | None:
        """The scale of an object; None for one that is a plain number."""
        for indices, kind, ask in (
            (TORQUES, "rated torque", self._torque),
            (CURRENTS, "rated current", self._current),
            (SPEEDS, "unit of speed", self._speed),
            (ANGLES, "unit of angle", self._angle),
        ):
            if index in indices:
                if kind not in self._kept:
                    self._kept[kind] = ask()
                return self._kept[kind]
        return Scale(Fraction(1, 1000), "V") if index == VOLTAGE else None

    def _torque(self) -> Scale:
        rated = self._rated(RATED_TORQUE, "6076h, rated torque")
        self.told["rated_torque"] = f"{rated / 1000:g} N m (6076h)"
        return Scale(Fraction(rated, 10**6), "Nm")

    def _current(self) -> Scale:
        kind = self._said.rated_current
        if not kind:
            raise DatabaseError(
                'canopen.rated_current: missing; 6078h counts per mille of 6075h: say "rms" or "peak", '
                "as the drive's manual has it"
            )
        rated = self._rated(RATED_CURRENT, "6075h, rated current")
        self.told["rated_current"] = f"{rated / 1000:g} A {kind} (6075h)"
        return Scale(Fraction(rated, 10**6), _CURRENT[kind])

    def _rated(self, index: int, what: str) -> int:
        rated = self._sdo.optional_int(index)
        if not rated:
            found = "is 0" if rated == 0 else "is not there"
            raise NodeError(
                f"node {self._sdo.node_id}: {what}, {found}; its values count per mille of that: set it "
                "with the drive's own tool"
            )
        return rated

    def _angle(self) -> Scale | None:
        """What 6064h counts in; None where nobody says: it stays a plain number, which no loop takes."""
        given, told = self._said.position_unit, self._told_angle()
        said = speed_scale(given, "canopen.position_unit", ANGLE) if given else None
        if told and said and not _same(told[0], said, ANGLE):
            raise DatabaseError(
                f'canopen.position_unit = "{given}", but {told[1]} says {_words(told[0])}; leave the key '
                "out, or set the drive's"
            )
        scale = told[0] if told else said
        if scale:
            self.told["unit_of_angle"] = f"{_words(scale)} ({told[1] if told else 'canopen.position_unit'})"
        return scale

    def _told_angle(self) -> tuple[Scale, str] | None:
        """The unit in 60A8h, else a turn by its increments."""
        raw = self._sdo.optional_int(ANGLE_UNIT) or 0
        if raw >> 16 & 0xFF in _ANGLES:
            power = (raw >> 24 ^ 0x80) - 0x80
            return Scale(Fraction(10) ** power, _ANGLES[raw >> 16 & 0xFF]), "60A8h"
        gear = [self._sdo.optional_int(GEAR, sub) for sub in (1, 2)]
        counts, turns = (self._sdo.optional_int(RESOLUTION, sub) for sub in (1, 2))
        if gear[0] != gear[1] or not counts or not turns:
            return None
        return Scale(Fraction(turns, counts), "rev"), "608Fh"

    def _speed(self) -> Scale:
        given = self._said.velocity_unit
        raw = self._sdo.optional_int(SPEED_UNIT)
        told = told_speed(raw) if raw else None
        said = speed_scale(given, "canopen.velocity_unit") if given else None
        if told is None and said is None:
            found = f"60A9h is 0x{raw:08X}, no unit that is known" if raw else "the drive has no 60A9h"
            raise DatabaseError(
                f'canopen.velocity_unit: missing, and {found}; say what 606Ch counts in: "rpm", "0.001 rpm", '
                '"1/4096 rev/s" (608Fh has the increments of a turn)'
            )
        if told and said and not _same(told, said):
            raise DatabaseError(
                f'canopen.velocity_unit = "{given}", but 60A9h = 0x{raw:08X} says {_words(told)}; leave the '
                "key out, or set the drive's"
            )
        scale = told or said
        assert scale is not None  # noqa: S101 - one of the two is there
        self.told["unit_of_speed"] = f"{_words(scale)} ({'60A9h' if told else 'canopen.velocity_unit'})"
        return scale


def _same(one: Scale, other: Scale, units: Mapping[str, float] = SPEED) -> bool:
    factors = [unit.factor if (unit := unit_of(scale.unit, units)) else 0.0 for scale in (one, other)]
    return abs(float(one.factor) * factors[0] / (float(other.factor) * factors[1]) - 1.0) < 1e-12


def _words(scale: Scale) -> str:
    return scale.unit if scale.factor == 1 else f"{float(scale.factor):g} {scale.unit}"
