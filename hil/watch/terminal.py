"""A run live in a terminal: sparklines, state, timing, events; q leaves, s stops the run."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Sequence
from itertools import cycle
from typing import Final

import numpy as np
import numpy.typing as npt
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from hil.errors import plain
from hil.runtime.arming import keys_at_once
from hil.runtime.registry import Entry
from hil.signals import FIELDS, Field, TickArray
from hil.watch.feed import LIVE
from hil.watch.look import Event, Look, figures, outcome

REFRESH_S: Final = 0.25
SHOWN_S: Final = 3.5  # the ring holds 4 s
BLOCKS: Final = "▁▂▃▄▅▆▇█"
COLOURS: Final = ("cyan", "blue", "yellow", "magenta", "green", "red")
STATE_STYLES: Final = {
    "operation_enabled": "bold green",
    "fault": "bold red",
    "quick_stop_active": "bold yellow",
}


def sparkline(values: npt.NDArray[np.float64], width: int, least_span: float) -> str:
    """``width`` characters; of each share of the values the one farthest from their median is drawn."""
    finite = values[np.isfinite(values)]
    if not len(finite) or width < 1:
        return ""
    middle, low, high = float(np.median(finite)), float(finite.min()), float(finite.max())
    spare = max(0.0, least_span - (high - low)) / 2
    low, span = low - spare, max(high - low + 2 * spare, 1e-12)
    shares = np.array_split(finite, min(width, len(finite)))
    drawn = (share[np.argmax(np.abs(share - middle))] for share in shares)
    top = len(BLOCKS) - 1
    return "".join(BLOCKS[round(min(max((value - low) / span, 0.0), 1.0) * top)] for value in drawn)


def lines(fields: Sequence[Field] = FIELDS) -> list[Field]:
    """The fields that have a line, by the plots of the live page."""
    order = dict(zip(LIVE, range(len(LIVE)), strict=True))
    return sorted((f for f in fields if f.shown.line), key=lambda f: order.get(f.shown.live, len(LIVE)))


def curves(ticks: TickArray, width: int, fields: Sequence[Field] = FIELDS) -> Table:
    """One row a signal that has numbers: newest value, sparkline, smallest and largest."""
    table = Table.grid(padding=(0, 1))
    for justify in ("left", "right", "left", "left", "right"):
        table.add_column(justify=justify, no_wrap=True)
    for field, colour in zip(lines(fields), cycle(COLOURS)):
        values = ticks[field.name].astype(np.float64) * field.scale
        if len(values) and not np.isnan(values).all():
            line = Text(sparkline(values, max(10, width - 56), field.shown.span), style=colour)
            ends = Text(f"{values.min():z.2f} .. {values.max():z.2f}", style="dim")
            unit = Text(field.drawn_unit, style="dim")
            table.add_row(field.shown.line, f"{values[-1]:z.2f}", unit, line, ends)
    return table


def _state(look: Look, ticks: TickArray) -> Text:
    now = figures(look, ticks)
    state, reason = now["state"], now["reason"]
    text = Text().append(state.replace("_", " "), style=STATE_STYLES.get(state, "bold"))
    if reason:
        text.append(f"  ({reason.replace('_', ' ')})", style="bold yellow")
    total = f" of {look.entry.ticks}" if look.entry.ticks else ""
    text.append(f"   tick {now['k']}{total}")
    if now.get("silent"):
        text.append(f"\nno tick for {now['age_s']:.1f} s: the loop hangs or is stopped", style="bold red")
    elif now.get("rate_hz"):
        late = now["lateness_us"]
        text.append(f"   {now['rate_hz']:.0f} Hz of {look.entry.rate_hz}")
        text.append(f"\nlateness p50 {late['p50']:.0f}, p99 {late['p99']:.0f}, max {late['max']:.0f} us   ")
        text.append(f"{now['skipped']} skipped", style="yellow" if now["skipped"] else "default")
        text.append(f"   {now['dropped']} dropped", style="red" if now["dropped"] else "default")
    return text


def _events(events: list[Event], entry: Entry) -> Text:
    """The newest events, one a line."""
    lines = [f"tick {k:<8d} {kind:12s} {text}" for _, k, kind, text in events]
    return Text(plain("\n".join(lines)) or f"no events yet on {entry.bus}", overflow="ellipsis", no_wrap=True)


def _node(look: Look) -> str:
    """Which of several nodes is seen, and how another one is."""
    others = ", ".join(f"--node {name}" for name in look.entry.nodes if name != look.node)
    return f"  node {look.node} (another: {others})" if look.node else ""


def frame(look: Look, width: int, note: str = "") -> RenderableType:
    """The whole view."""
    ticks = look.latest(round(SHOWN_S * look.entry.rate_hz))
    entry = look.entry
    body = Group(
        _state(look, ticks),
        Text(""),
        curves(ticks, width),
        Text(""),
        _events(look.events(5), entry),
        Text(plain(f"\nlog {entry.log}"), style="dim", overflow="fold"),
    )
    return Panel(
        body,
        title=Text(plain(f"hil run  PID {entry.pid}  {entry.bus}{_node(look)}")),
        subtitle=note or None,
        title_align="left",
    )


def once(look: Look) -> None:
    """Print one frame."""
    console = Console()
    width = console.width if console.is_terminal else 110
    Console(width=width).print(frame(look, width))


def _key(wait_s: float) -> str:
    """The key pressed within a time; empty when none or when standard input is no terminal."""
    if not sys.stdin.isatty():
        select.select([], [], [], wait_s)
        return ""
    if not select.select([sys.stdin], [], [], wait_s)[0]:
        return ""
    return os.read(sys.stdin.fileno(), 64).decode(errors="replace")[:1] or "q"


def who(kind: str) -> str:
    """This viewer, for the log."""
    return f"hil watch in the {kind}, user id {os.getuid()}, process {os.getpid()}"


def live(look: Look) -> str:
    """Show the run until it ends or q is pressed; say what came of it."""
    console = Console()
    note, asking = "q leaves, s stops the run", False
    with (
        keys_at_once(sys.stdin.fileno()),
        Live(console=console, auto_refresh=False, screen=console.is_terminal) as shown,
    ):
        while look.alive:
            shown.update(frame(look, console.width, note), refresh=True)
            key = _key(REFRESH_S)
            if asking and key:
                note, asking = look.stop(who("terminal")) if key == "y" else "not stopped", False
            elif key == "s":
                note, asking = "stop the run? y stops it, any other key does not", True
            elif key == "q":
                return "left; the run goes on"
    return f"the run has ended: {outcome(look.entry.log)}"
