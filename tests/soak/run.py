"""A long run at 1 kHz on the default bus: memory, descriptors, threads flat, nothing lost, the log replays.

    python -m tests.soak.run --seconds 600

Emulated drive and controller run as their users start them; from outside their processes are looked at ten
times a second at most. Every bound is printed beside what was found; exit code 1 when one is passed.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from hil.log.reader import open_log
from hil.replay import replay
from hil.runtime.setup import Overrides
from hil.sim.demo import emulator_process

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "demo.toml"
SAMPLES = 400
GROWTH_KIB = {"controller": 512, "guardian": 512, "writer": 2048, "emulator": 512}
"""Most that the private memory may grow from the first quarter's median to the last's; the writer's buffers
take a while to find their size."""
WRITER_KIB_PER_MIN = 256
"""On top for the writer: it keeps the index of the chunks for the summary at the end of the file."""


@dataclass
class Track:
    """What was seen of one process: private memory [KiB], open descriptors, threads."""

    pid: int
    memory: list[int] = field(default_factory=list)
    descriptors: list[int] = field(default_factory=list)
    threads: list[int] = field(default_factory=list)

    def look(self) -> None:
        """One more sample. Raises OSError once the process has gone."""
        status = Path(f"/proc/{self.pid}/status").read_text(encoding="ascii", errors="replace")
        values = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
        if "RssAnon" not in values:
            raise ProcessLookupError(self.pid)
        count = len(list(Path(f"/proc/{self.pid}/fd").iterdir()))
        self.memory.append(int(values["RssAnon"].split()[0]))
        self.threads.append(int(values["Threads"]))
        self.descriptors.append(count)

    def quarters(self, values: list[int]) -> tuple[float, float]:
        """Medians of the first and of the last quarter."""
        quarter = max(1, len(values) // 4)
        return statistics.median(values[:quarter]), statistics.median(values[-quarter:])


@dataclass(frozen=True)
class Finding:
    """One line of the table."""

    what: str
    found: str
    bound: str
    good: bool


def settings(seconds: float, folder: Path) -> tuple[str, ...]:
    """The demo, long: a load that never rests, patient with a shared machine."""
    return (
        f'bus.channel="soak-{uuid.uuid4().hex[:12]}"',
        f'log.folder="{folder}"',
        'log.name="soak"',
        f"loop.duration_s={seconds}",
        f"reference.down_at_s={seconds - 1.0}",
        "loop.max_gap_ticks=64",
        "feedback.hold_ticks=200",
    )


PLANT = (
    'load=[{kind="constant", torque_n_m=1.0}, {kind="sine", torque_n_m=4.0, frequency_hz=0.5}]',
    "firmware.watchdog_ms=400.0",
)


def relatives(pid: int) -> dict[str, int]:
    """The guardian and the writer of a controller."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    lines = {int(child): Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
    return {"writer" if b"hil.log.writer" in line else "guardian": child for child, line in lines.items()}


def watch(tracks: dict[str, Track], running: Callable[[], bool], every_s: float) -> None:
    """Look at all processes until the run ends."""
    while running():
        for track in tracks.values():
            try:
                track.look()
            except OSError:
                return
        time.sleep(every_s)


def soak(seconds: float, folder: Path) -> tuple[dict[str, Any], dict[str, Track], Path]:
    """Run; what the controller said, what was seen of the processes, the log."""
    own, log = settings(seconds, folder), folder / "soak.mcap"
    words = [word for setting in own for word in ("--set", setting)]
    command = [sys.executable, "-m", "hil.cli", "run", str(CONFIG), "--json", *words]
    with emulator_process(CONFIG, Overrides(settings=own), PLANT) as drive:
        run = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            while not (log.is_file() and log.stat().st_size > 20_000) and run.poll() is None:
                time.sleep(0.05)
            pids = {"controller": run.pid, "emulator": drive}
            pids |= relatives(run.pid) if run.poll() is None else {}
            tracks = {name: Track(pid) for name, pid in pids.items()}
            end = time.monotonic() + 0.95 * seconds  # what happens at the end is no leak
            every_s = max(0.1, seconds / SAMPLES)
            watch(tracks, lambda: run.poll() is None and time.monotonic() < end, every_s)
            said = run.communicate(timeout=seconds + 60.0)[0]
        finally:
            run.kill()
    return json.loads(said or "{}"), tracks, log


def process_findings(name: str, track: Track, seconds: float) -> Iterator[Finding]:
    """Memory, descriptors and threads of one process."""
    if len(track.memory) < 8:
        yield Finding(name, f"seen {len(track.memory)} times", "8 times or more", False)
        return
    first, last = track.quarters(track.memory)
    most = GROWTH_KIB[name] + (WRITER_KIB_PER_MIN * seconds / 60 if name == "writer" else 0)
    found = f"{first:.0f} to {last:.0f} KiB ({last - first:+.0f})"
    yield Finding(f"{name}: private memory", found, f"at most {most:+.0f} KiB", last - first <= most)
    for what, values in (("descriptors", track.descriptors), ("threads", track.threads)):
        first, last = track.quarters(values)
        yield Finding(f"{name}: {what}", f"{first:.0f} to {last:.0f}", "no more in the end", last <= first)


def run_findings(result: dict[str, Any], log: Path, seconds: float) -> Iterator[Finding]:
    """What the run itself and its log say."""
    ended, dropped = result.get("ended", "nothing"), result.get("dropped")
    yield Finding("run ended by", ended, "stop_requested", ended == "stop_requested")
    yield Finding("records dropped", str(dropped), "0", dropped == 0)
    ticks = open_log(log, frames=False).ticks
    late_us = ticks["lateness_ns"] * 1e-3
    span = float(ticks["t_ns"][-1] - ticks["t_ns"][0]) * 1e-9
    yield Finding("time in the log", f"{span:.1f} s", f"{seconds:g} s or more", span >= seconds)
    held = int(ticks["skipped"].sum()) + len(ticks)
    whole = held == int(ticks["k"][-1]) + 1
    yield Finding("periods accounted for", f"{held} of {int(ticks['k'][-1]) + 1}", "all", whole)
    lateness = f"p50 {np.percentile(late_us, 50):.0f}, p99.9 {np.percentile(late_us, 99.9):.0f} us"
    yield Finding("ticks, periods skipped", f"{len(ticks)}, {int(ticks['skipped'].sum())}", "shown", True)
    yield Finding("lateness", f"{lateness}, most {late_us.max():.0f} us", "shown", True)
    verdict = replay(log)
    yield Finding("replay", f"{verdict.verdict} {verdict.why}".strip(), "same", verdict.verdict == "same")
    yield Finding("log", f"{log.stat().st_size / 2**20:.1f} MiB", "shown", True)


def findings(seconds: float, folder: Path) -> list[Finding]:
    """The whole soak."""
    result, tracks, log = soak(seconds, folder)
    if not log.is_file():
        return [Finding("run", f"left no log: {result}", "a log", False)]
    seen = [f for name, track in sorted(tracks.items()) for f in process_findings(name, track, seconds)]
    missing = sorted(set(GROWTH_KIB) - set(tracks))
    seen += [Finding(name, "not there", "running", False) for name in missing]
    return [*run_findings(result, log, seconds), *seen]


def show(found: list[Finding], seconds: float) -> None:
    """The table and the verdict."""
    table = Table(title=f"soak: {seconds:g} s at 1 kHz on the default bus", title_justify="left")
    for title in ("what", "found", "bound", "verdict"):
        table.add_column(title, overflow="fold")
    for one in found:
        table.add_row(one.what, one.found, one.bound, "good" if one.good else "[red]BAD[/]")
    Console(width=110).print(table)
    bad = [one.what for one in found if not one.good]
    print(f"soak: {'good' if not bad else 'bad: ' + ', '.join(bad)}")


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = findings(args.seconds, Path(folder))
    show(found, args.seconds)
    return 0 if all(one.good for one in found) else 1


if __name__ == "__main__":
    sys.exit(main())
