"""Progress of a run on a terminal, drawn by a process of its own that looks into the loop's tick ring.

The loop neither waits for it nor knows of it. Where standard error is no terminal, plain lines are printed
before and after the run and nothing is drawn.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator

from hil.errors import plain
from hil.log.ring import RingError, attach
from hil.runtime.clock import RealClock
from hil.signals import TICK, DriveState, ticks_from

REFRESH_NS = 100_000_000


def say(text: str) -> None:
    """One plain line on standard error."""
    print(plain(f"hil: {text}"), file=sys.stderr, flush=True)  # noqa: T201


@contextlib.contextmanager
def watching(pid: int, ticks: int | None) -> Iterator[None]:
    """Draw the progress of the loop in process ``pid`` while the block runs, if there is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    command = [sys.executable, "-m", "hil.runtime.progress", str(pid), str(ticks or 0)]
    drawer = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        yield
    finally:
        drawer.terminate()
        drawer.wait()


def draw(pid: int, total: int) -> None:
    """Show tick, speed and state of the newest record until the process has gone or we are ended."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    clock = RealClock()
    ring = attach(pid, "ticks", TICK.itemsize)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("tick {task.completed}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("arming", total=total or None)
        while _alive(pid):
            newest = ticks_from(ring.latest(1))
            if len(newest):
                t = newest[-1]
                state = DriveState(int(t["state"])).name.lower().replace("_", " ")
                progress.update(
                    task, completed=int(t["k"]), description=f"{state}, {float(t['w']):7.2f} rad/s"
                )
            clock.sleep_until(clock.now_ns() + REFRESH_NS)


def _alive(pid: int) -> bool:
    """True while the process has its ring."""
    try:
        attach(pid, "ticks", TICK.itemsize).close()
    except RingError:
        return False
    return True


if __name__ == "__main__":
    with contextlib.suppress(RingError, KeyboardInterrupt):
        draw(int(sys.argv[1]), int(sys.argv[2]))
