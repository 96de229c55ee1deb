"""What a replay found: same, differs, or cannot; exit codes 0, 1, 2."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np


@dataclass(frozen=True, slots=True)
class Difference:
    """The first output that is not the same to the bit."""

    tick: int
    field: str
    logged: float
    replayed: float
    ulp: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a replay found; ``why`` says what kept it from comparing, or what the log lacks."""

    verdict: Literal["same", "differs", "cannot"]
    ticks: int
    first_difference: Difference | None = None
    why: str = ""
    notes: tuple[str, ...] = ()
    """What another version's log lacks or this version would do otherwise, and what was taken for it."""
    nodes: dict[str, Verdict] = field(default_factory=dict)
    """Of a run with several nodes each one's; the worst is the run's."""

    @property
    def exit_code(self) -> int:
        """0 same, 1 differs, 2 cannot."""
        return {"same": 0, "differs": 1, "cannot": 2}[self.verdict]

    def as_dict(self) -> dict[str, Any]:
        """JSON form; values that are not finite as text, since JSON has none."""
        first = self.first_difference
        out: dict[str, Any] = {
            "verdict": self.verdict,
            "ticks": self.ticks,
            "first_difference": None,
            "why": self.why,
            "notes": list(self.notes),
        }
        if self.nodes:
            out["nodes"] = {name: verdict.as_dict() for name, verdict in self.nodes.items()}
        if first is not None:
            out["first_difference"] = {
                "tick": first.tick,
                "field": first.field,
                "logged": _json_number(first.logged),
                "replayed": _json_number(first.replayed),
                "ulp": first.ulp,
            }
        return out


def _json_number(value: float) -> float | str:
    return value if np.isfinite(value) else repr(value)
