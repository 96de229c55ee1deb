"""A part of a report that a later room makes: what the page shows of it, and what ``--json`` says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hil.report.collect import Run


@dataclass(frozen=True, slots=True)
class Section:
    """``key`` in the JSON form, title and HTML on the page."""

    key: str
    title: str
    html: str
    data: dict[str, Any]


Sections = Callable[[Sequence[Run]], Sequence[Section]]


def no_more(_runs: Sequence[Run]) -> Sequence[Section]:
    """The report of a run like any other."""
    return ()
