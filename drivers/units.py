"""Units as people write them in DBC files, and the factor of each to SI; what is ambiguous is none.

Amplitude-invariant dq: a current or voltage of A or V rms is sqrt(2) of its peak. Electrical speeds need the
number of pole pairs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

ELECTRICAL: Final = math.nan
"""Stands for the factor of a speed that counts electrical turns: it is pi / 30 by the pole pairs."""
RATED: Final = math.inf
"""Stands for the factor of a value in thousandths of the drive's rated one."""
_TURN: Final = 2.0 * math.pi
_RMS: Final = math.sqrt(2.0)


def _table(*rows: tuple[float, str]) -> dict[str, float]:
    return {name: factor for factor, names in rows for name in names.split()}


# written without blanks, brackets and signs of multiplication; the first is SI
SPEED: Final = _table(
    (1.0, "rad/s rad/sec rads/s rad/second rads-1 rads^-1 radian/s radians/s 1rad/s"),
    (
        math.pi / 30.0,
        "rpm 1/min r/min rev/min min-1 min^-1 /min u/min turns/min rotations/min revs/min 1/minute",
    ),
    (1000.0 * math.pi / 30.0, "krpm"),
    (_TURN, "rev/s rps r/s revs/s turns/s turn/s u/s rev/sec rotations/s"),
    (math.pi / 180.0, "deg/s °/s deg/sec degree/s degrees/s"),
    (ELECTRICAL, "erpm erev/min e-rpm rpm_el rpmel rpm(el)"),
)
CURRENT: Final = _table(
    (1.0, "A Apk Ap Apeak A_peak Apeak Amp Amps ampere amperes"),
    (1e-3, "mA mApk mAmp"),
    (_RMS, "Arms A_rms Aeff Amprms"),
    (1e-3 * _RMS, "mArms mA_rms"),
    (RATED, "permille per_mille promille ‰ 1/1000 0.1%"),
)
VOLTAGE: Final = _table((1.0, "V Vpk Vp Vpeak V_peak Volt Volts VDC V_dc"), (1e-3, "mV"), (1e3, "kV"))
ANGLE: Final = _table(
    (1.0, "rad radian radians"),
    (_TURN, "rev turn turns revs rotation rotations revolution revolutions r"),
    (math.pi / 180.0, "deg ° degree degrees"),
)
CELSIUS: Final = _table((1.0, "degC C °C ºC ℃ Celsius degreeC degreesC gradC degCelsius deg_C"))
TORQUE: Final = _table((1.0, "Nm N_m newtonmeter newtonmetre"), (1e-3, "mNm"), (1e3, "kNm"))
DRIVE_TORQUE: Final = TORQUE | _table((RATED, "permille per_mille promille ‰ 1/1000 0.1%"))
FIRST: Final = {
    id(ANGLE): "rad",
    id(SPEED): "rad/s",
    id(CURRENT): "A",
    id(VOLTAGE): "V",
    id(CELSIUS): "degC",
    id(TORQUE): "N m",
    id(DRIVE_TORQUE): "N m",
}
_SHOWN: Final = {
    id(ANGLE): "rad, rev, deg, 1/4096 rev (of an encoder that counts so many a turn)",
    id(SPEED): "rad/s, rpm, 1/min, rev/s, deg/s, erpm",
    id(CURRENT): "A, mA, Arms",
    id(VOLTAGE): "V, mV, kV",
    id(CELSIUS): "degC",
    id(TORQUE): "N m, mNm",
    id(DRIVE_TORQUE): "N m, mNm, per mille",
}
_SPELLING: Final = str.maketrans({"⁻": "-", "¹": "1", "−": "-"} | dict.fromkeys("·*×⋅ \xa0\t[]"))
_COUNTED: Final = re.compile(r"\s*(\d+(?:\.\d+)?)\s*/\s*(\d+(?:\.\d+)?)\s+(\S.*)")
_MILLI: Final = re.compile(r"M(?=v|a|n)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit that is known: its factor to SI, or of what it counts: electrical turns, the rated value."""

    factor: float
    electrical: bool = False
    rated: bool = False


def shown(units: Mapping[str, float]) -> str:
    """The units that are known, as they are told to somebody who wrote another."""
    return _SHOWN[id(units)]


def plain(text: str) -> str:
    """A unit without what means nothing: blanks, brackets, signs of multiplication, a quantity before it."""
    return text.strip().rpartition(":")[2].translate(_SPELLING).replace("Â", "").replace("N-m", "Nm")


def unit_of(text: str, units: Mapping[str, float]) -> Unit | None:
    """What a unit is among those of a quantity; None for one that is not known or could be two.

    Upper and lower case are the same, but for M and m, which are a factor of a thousand million. Before the
    unit may stand what one count is of it: "1/4096 rev".
    """
    if (counted := _COUNTED.fullmatch(text)) and float(counted[2]):
        unit = unit_of(counted[3], units)
        return unit and replace(unit, factor=unit.factor * float(counted[1]) / float(counted[2]))
    wanted = plain(text)
    factor = units.get(wanted)
    if factor is None and not (wanted.startswith("M") and _MILLI.match(wanted)):
        factor = {name.lower(): value for name, value in units.items()}.get(wanted.lower())
    if factor is None:
        return None
    if math.isinf(factor):
        return Unit(1e-3, rated=True)
    return Unit(math.pi / 30.0, electrical=True) if math.isnan(factor) else Unit(factor)
