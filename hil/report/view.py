"""Tables on the terminal; plain lines where standard output is none."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from hil.errors import plain
from hil.signals import Reason

REFRESH_S: Final = 0.1

if TYPE_CHECKING:  # a table must not wait for the compiler and the bus
    from hil.replay import Verdict
    from hil.replay.whatif import WhatIf
    from hil.runtime.session import RunResult


def show(table: Table) -> None:
    """Print a table, never narrower than its paths need when the output is no terminal."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)
    console.print(table)


def key_values(title: str, values: dict[str, Any]) -> Table:
    """A two-column table."""
    table = Table(title=words(title), title_justify="left", show_header=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for key, value in values.items():
        table.add_row(words(key), _text(value))
    return table


def words(text: Any) -> Text:
    """Text from a log, a path or a config as it stands: no markup, nothing that commands the terminal."""
    return Text(plain(str(text)))


def _text(value: Any) -> Text:
    if isinstance(value, float):
        return Text(f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}")
    return words(value)


def _number(value: float | None, unit: str, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}"


def demo_table(result: dict[str, Any]) -> Table:
    """What the demo shows at its end."""
    late, replay = result["lateness_us"], result["replay"]
    step = result["estimate_step_rad_s2"]
    rows = {
        "tracking error": _number(result["tracking_rms_rad_s"], "rad/s rms"),
        "load step": "-" if step is None else f"{step:.0f} rad/s2 in d_w (seen by nobody but the emulator)",
        "speed dip": _number(result["dip_rad_s"], "rad/s"),
        "recovery to 0.5 rad/s": _number(result["recovery_ms"], "ms", 0),
        f"estimate error after N = {result['n']} ticks": (
            f"{_number(result['estimate_error_after_n'], 'rad/s2')} "
            f"(frame resolution alone: up to {result['estimate_bound_rad_s2']:.2f})"
        ),
        "ticks": f"{result['ticks']}, {result['skipped']} skipped, {result['dropped']} records dropped",
        "lateness": " / ".join(f"{late[key]:.0f}" for key in ("p50", "p99", "p999", "max"))
        + " us (p50 / p99 / p99.9 / max)",
        "granted": ", ".join(
            f"{g['what']}: {g['detail'] if g['granted'] else 'no, ' + g['detail']}" for g in result["grants"]
        )
        or "nothing asked (lockstep)",
        "ended": result["ended"] + (f" in lockstep: {result['too_slow']}" if result.get("too_slow") else ""),
        **end_rows(result["end"]),
        **node_rows(result.get("nodes", {})),
        "replay": verdict_text(replay),
        "log": result["log"],
    }
    return key_values("hil demo", rows)


def verdict_text(replay: dict[str, Any]) -> str:
    """A verdict in one line."""
    first = replay["first_difference"]
    text = {"same": f"same to the bit, {replay['ticks']} ticks", "cannot": "cannot"}.get(
        replay["verdict"], "differs"
    )
    if first:
        text += (
            f" from tick {first['tick']} on: {first['field']} logged {first['logged']}, "
            f"replayed {first['replayed']} ({first['ulp']} ulp)"
        )
    text += f" ({', '.join(replay['nodes'])})" if "nodes" in replay else ""
    return "; ".join([text, *([replay["why"]] if replay["why"] else []), *replay.get("notes", ())])


def end_rows(end: dict[str, Any] | None) -> dict[str, str]:
    """Why a run ended that nobody asked to end, and what to do."""
    if end is None or end["reason"] in ("stop_requested", "quick_stop_requested"):
        return {}
    return {"why": end["text"], "what to do": end["remedy"]}


def node_rows(nodes: dict[str, Any]) -> dict[str, str]:
    """How each node of a run with several ended."""
    return {f"node {name}": node["ended"].replace("_", " ") for name, node in nodes.items()}


def run_table(result: RunResult) -> Table:
    """What a run says at its end."""
    rows: dict[str, Any] = {
        "ended": Reason(result.outcome.reason).name.lower().replace("_", " "),
        **end_rows(result.end.as_dict() if result.end else None),
        **node_rows(result.nodes),
        "ticks": f"{result.outcome.ticks}, {result.outcome.skipped} skipped",
        "records dropped": result.dropped,
    }
    for grant in result.grants:
        rows[grant.what] = grant.detail if grant.granted else f"not granted: {grant.detail}"
    rows["log"] = result.log + ("" if result.complete else " (incomplete)")
    return key_values("hil run", rows)


def replay_table(results: list[tuple[Path, Verdict, float]]) -> Table:
    """What replays found, one row a log."""
    table = Table(title="hil replay", title_justify="left")
    for name in ("log", "verdict"):
        table.add_column(name, overflow="fold")
    table.add_column("s", justify="right")
    for path, verdict, seconds in results:
        table.add_row(words(path), words(verdict_text(verdict.as_dict())), f"{seconds:.2f}")
    return table


def sweep_table(rows: list[dict[str, Any]]) -> Table:
    """The cases of a sweep, one row each."""
    table = Table(title="hil simulate", title_justify="left")
    for setting in rows[0]["case"]:
        table.add_column(words(setting.partition("=")[0]))
    table.add_column("ended")
    columns = {"tracking_rms_rad_s": "rad/s rms", "dip_rad_s": "rad/s", "recovery_ms": "ms", "i_max_a": "A"}
    for name in ("tracking", "dip", "recovery", "largest |i|"):
        table.add_column(name, justify="right")
    for row in rows:
        values = [words(setting.partition("=")[2]) for setting in row["case"]]
        numbers = [_number(row[key], unit) for key, unit in columns.items()]
        table.add_row(*values, row["ended"].replace("_", " "), *numbers)
    return table


def what_if_table(found: WhatIf) -> Table:
    """How another controller differs from the one that ran."""
    table = Table(title=words(f"{found.config.name} over {found.log.name}, open loop"), title_justify="left")
    table.add_column("new - logged")
    for name in ("rms", "max", "ticks"):
        table.add_column(name, justify="right")
    for row in found.as_dict()["rows"]:
        unit = row["unit"]
        table.add_row(
            row["signal"], f"{row['rms']:.4g} {unit}", f"{row['max']:.4g} {unit}", str(row["ticks"])
        )
    return table


@contextlib.contextmanager
def progress(text: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error for as long as the block runs; nothing where that is no terminal.

    It has no thread of its own, beside which no log would be read in a second process.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    with Progress(console=console, transient=True, auto_refresh=False) as bar:
        task, shown = bar.add_task(escape(plain(text)), total=total), 0.0

        def seen(done: int) -> None:
            nonlocal shown
            bar.update(task, completed=done)
            if bar.get_time() - shown > REFRESH_S:
                bar.refresh()
                shown = bar.get_time()

        yield seen
