"""The matrix as a table on the terminal."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from hil.errors import plain
from hil.faults.judge import AS_EXPECTED, Result


def number(value: float | None, digits: int = 1) -> str:
    """A number or a dash."""
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def table(results: list[Result]) -> Table:
    """One line a row; what stands against a row is below its verdict."""
    out = Table(title="hil faults", title_justify="left")
    out.add_column("fault", overflow="fold")
    out.add_column("expected", overflow="fold")
    out.add_column("reaction", overflow="fold")
    for name in ("safe after ms", "|w| rad/s", "|i| A", "|u| V"):
        out.add_column(name, justify="right")
    for name in ("log", "replay", "verdict"):
        out.add_column(name, overflow="fold")
    for r in results:
        good = r.verdict == AS_EXPECTED
        verdict = Text(r.verdict, style="green" if good else "red")
        if not good:
            verdict.append(plain(f": {'; '.join(r.why)}"), style="default")
        numbers = (number(r.time_to_safe_ms), number(r.w_worst_rad_s), number(r.i_worst_a, 2))
        said = [Text(plain(text)) for text in (r.fault, r.expected, r.reaction)]
        found = [Text(plain(text)) for text in (r.log, r.replay)]
        out.add_row(*said, *numbers, number(r.u_worst_v, 0), *found, verdict)
    return out


def closing(results: list[Result]) -> str:
    """How many rows are as expected."""
    good = sum(r.verdict == AS_EXPECTED for r in results)
    return f"{good} of {len(results)} rows as expected"
