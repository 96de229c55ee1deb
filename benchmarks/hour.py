"""What is done with the log of an hour at 1 kHz: seconds, processor seconds and peak memory of each command.

    python -m benchmarks.hour [--json] [--keep FOLDER] [ENDING ...]

Two logs: 3.6 million ticks by `hil simulate`; and the same ticks with three made-up frames each, 10.8
million, as a run on a bus logs them. Frames hold random bytes, which compress worse than a run's. With
endings (.parquet .csv ...) only these exports are made.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from hil.config.shipped import find_config
from hil.exchange.export import FORMATS
from hil.log.mcapfile import RunFile
from hil.log.reader import new_log, read_blocks
from hil.log.schema import FRAME, Records
from hil.report.view import show
from hil.signals import TickArray

FRAMES = ((0x080, 0, 1), (0x181, 1, 8), (0x201, 0, 8))  # identifier, received, bytes


@dataclass(frozen=True, slots=True)
class Cost:
    """What a command took; ``peak_mb`` is the largest resident memory of its process."""

    command: str
    seconds: float
    processor_s: float
    peak_mb: float
    file_mb: float


def cost(out: Path, *words: str) -> Cost:
    """Run a command of hil that writes ``out``."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "hil.cli", *words], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - start
    text = " ".join(("hil", *(Path(word).name if "/" in word else word for word in words)))
    if process.returncode:
        raise SystemExit(f"{text} ended with {process.returncode}")
    processor_s = usage.ru_utime + usage.ru_stime
    return Cost(text, seconds, processor_s, usage.ru_maxrss / 1e3, out.stat().st_size / 1e6)


def simulated(log: Path) -> Cost:
    """An hour of the demo."""
    settings = (f'log.folder="{log.parent}"', f'log.name="{log.stem}"', "reference.down_at_s=3500.0")
    flags = [part for setting in settings for part in ("--set", setting)]
    found = cost(log, "simulate", str(find_config("demo.toml")), "--duration", "3600", *flags)
    return Cost("hil simulate --duration 3600", *list(asdict(found).values())[1:])


def frames_of(ticks: TickArray, rng: np.random.Generator) -> Records:
    """SYNC, feedback and command of each tick, of random bytes, 0.1 ms after each other."""
    out = np.zeros(len(ticks) * len(FRAMES), FRAME)
    for at, (can_id, received, size) in enumerate(FRAMES):
        own = out[at :: len(FRAMES)]
        own["can_id"], own["received"], own["size"] = can_id, received, size
        own["t_ns"] = ticks["t_ns"] + at * 100_000
        own["data"][:, :size] = rng.integers(0, 256, (len(ticks), size))
    return out


def with_frames(source: Path, out: Path) -> None:
    """The log ``source`` with frames."""
    log, rng = new_log(source), np.random.default_rng(1)
    blocks = read_blocks(log)
    first = next(blocks)  # what stands before it in the file is known then
    with RunFile(out, {"metadata": log.metadata["run"], "attachments": log.attachments}) as file:
        for block in itertools.chain([first], blocks):
            file.add_ticks(block.records)
            file.add_frames(frames_of(block.records, rng))
        file.finish(log.result)


def costs(folder: Path, endings: list[str]) -> Iterator[Cost]:
    """Every command, one after the other; what it wrote goes again."""
    plain, full = folder / "hour.mcap", folder / "frames.mcap"
    if not plain.exists():
        yield simulated(plain)
    if not full.exists():
        with_frames(plain, full)
    if not endings:
        for log in (plain, full):
            yield cost(log, "info", str(log))
            yield cost(log, "replay", str(log))
            out = folder / f"{log.stem}.html"
            yield cost(out, "report", str(log), "-o", str(out))
    for ending in endings or FORMATS:
        for log in (plain, full) if FORMATS[ending][0] == "ticks" else (full,):
            out = folder / f"{log.stem}{ending}"
            yield cost(out, "export", str(log), "-o", str(out))
            out.unlink()
        if ending == ".mf4":
            yield cost(out, "export", "--frames", str(full), "-o", str(out))
            out.unlink()


def main() -> None:
    """Print a row a command as it ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("endings", nargs="*", metavar="ENDING", default=[])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="make the logs there, or take them there")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        found = []
        for one in costs(args.keep or Path(name), args.endings):
            found.append(one)
            sys.stderr.write(f"{one.seconds:.0f} s: {one.command}\n")
    if args.json:
        sys.stdout.write(json.dumps([asdict(one) for one in found], indent=2) + "\n")
        return
    table = Table(title="a log of an hour at 1 kHz", title_justify="left")
    for title in ("command", "s", "processor s", "peak MB", "file MB"):
        table.add_column(title, justify="left" if title == "command" else "right", overflow="fold")
    for one in found:
        digits = (f"{value:.1f}" for value in (one.seconds, one.processor_s, one.peak_mb, one.file_mb))
        table.add_row(one.command, *digits)
    show(table)


if __name__ == "__main__":
    main()
