"""One row of the verdict table: what the paper prints, what comes out, and what follows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Final, Literal

Verdict = Literal["equal", "equal after correction", "cannot be"]
EQUAL: Final[Verdict] = "equal"
CORRECTED: Final[Verdict] = "equal after correction"
CANNOT: Final[Verdict] = "cannot be"


@dataclass(frozen=True, slots=True)
class Item:
    """A row; numbers are text with the digits that carry meaning."""

    item: str
    where: str
    printed: str
    computed: str
    verdict: Verdict
    why: str

    def as_dict(self) -> dict[str, str]:
        """JSON form."""
        return dict(asdict(self))


def numbers(values: Iterable[float], digits: int = 4) -> str:
    """Comma-separated fixed-point numbers, without a sign on zero."""
    return ", ".join(f"{round(float(value), digits) + 0.0:.{digits}f}" for value in values)


def same_digits(printed: Iterable[float], computed: Iterable[float], digits: int) -> bool:
    """True when the computed numbers round to the printed ones."""
    pairs = zip(printed, computed, strict=True)
    return all(abs(round(float(c), digits) - p) < 0.5 * 10**-digits for p, c in pairs)


def judged(holds: bool, otherwise: Verdict = CANNOT, verdict: Verdict = EQUAL) -> Verdict:
    """``verdict`` when the check holds, else the other: a row must be able to fail."""
    return verdict if holds else otherwise
