"""Reports an hour's log at 1 kHz (3.6 million ticks, made by hil simulate): seconds, peak memory, page size.

python benchmarks/report_hour.py [LOG]: with LOG, that log is reported and none is made.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def hil(*args: str) -> float:
    """Run a command of hil as a process; its seconds."""
    start = time.perf_counter()
    command = [sys.executable, "-m", "hil.cli", *args]
    subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, timeout=900, check=True)
    return time.perf_counter() - start


def say(text: str) -> None:
    """Print a line."""
    sys.stdout.write(text + "\n")


def make_log(folder: Path) -> Path:
    """An hour of the demo."""
    settings = (f'log.folder="{folder}"', 'log.name="hour"', "reference.down_at_s=3500.0")
    flags = [part for setting in settings for part in ("--set", setting)]
    seconds = hil("simulate", "configs/demo.toml", "--duration", "3600", *flags)
    say(f"simulated and written in {seconds:.1f} s")
    return folder / "hour.mcap"


def main() -> None:
    """Make the log when none is named, and report it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else make_log(folder)
        seconds = hil("report", str(log), "-o", str(folder / "hour.html"))
        peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
        megabytes = [path.stat().st_size / 1e6 for path in (log, folder / "hour.html")]
        say(f"{megabytes[0]:.0f} MB reported in {seconds:.1f} s, page {megabytes[1]:.1f} MB")
        say(f"peak memory of the largest process {peak_mb:.0f} MB")


if __name__ == "__main__":
    main()
