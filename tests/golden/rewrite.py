"""`make golden`: run the golden scenarios with today's code and say what changed against the kept logs.

The kept logs stay as they are. With ``--keep NAME`` today's are kept beside them as another generation; with
``--sign REASON`` what a kept log replays as today is signed. Both rewrite the checksums. Where scenarios are
named, these alone are run.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from hil.log.reader import open_log
from hil.signals import FIELDS
from tests.conftest import CONFIGS
from tests.golden import kept

RAMP = ["--set", 'reference={kind="ramp", w_rad_s=60.0, rate_rad_s2=300.0, at_s=0.05}']
MOVE = [
    "--set",
    'reference={kind="move",target_turns=2.0,w_rad_s=30.0,rate_rad_s2=200.0,jerk_rad_s3=4000.0,at_s=0.1}',
]
BEAT = ["--set", "drive.heartbeat_timeout_s=20.0"]
"""A run in lockstep may be late for a heartbeat, which goes by the wall's clock."""
DROP = '[{kind="drop",at_s=0.2,for_s=0.1,share=0.1,seed=11},{kind="drop",at_s=0.4}]'
SIMULATED = {
    "simulate": ("demo.toml", 0.8, RAMP),
    "fac": ("paper.toml", 0.6, []),
    "split": ("demo.toml", 1.2, ["--set", "log.split_s=1.0"]),
}
BUS: dict[str, tuple[str, float, list[str], list[str]]] = {
    "lockstep": ("demo.toml", 0.8, ["--lockstep"], ["--lockstep", *BEAT, *RAMP]),
    "lockstep-fac": ("paper.toml", 0.5, ["--lockstep"], ["--lockstep", *BEAT]),
    "fault": (
        "demo.toml",
        1.2,
        ["--lockstep", "--plant-set", f"fault={DROP}"],
        ["--lockstep", *BEAT, *RAMP, "--set", "feedback.hold_ticks=5"],
    ),
    "inverter": ("inverter.toml", 0.8, [], BEAT),
    "own-loop": ("current.toml", 0.8, ["--lockstep"], ["--lockstep", *BEAT, *RAMP]),
    "position": ("position.toml", 1.5, ["--lockstep"], ["--lockstep", *BEAT, *MOVE]),
    "two-nodes": ("dyno-fac.toml", 0.8, ["--lockstep"], ["--lockstep"]),
}
"""Config, seconds, words for the emulator, words for the run; the inverter alone runs in real time."""
CANOPEN = {"position": ([],), "two-nodes": (["--set", "node=motor"], ["--set", "node=load"])}
"""What `hil configure` is called with before a run, once for each drive."""
HIL = (sys.executable, "-m", "hil.cli")


def say(text: str) -> None:
    """One line of the result."""
    print(text, flush=True)


def names(folder: Path, name: str) -> list[str]:
    """Where a run puts its log."""
    return ["--set", f'log.folder="{folder}"', "--set", f'log.name="{name}"', "--json"]


def simulate(folder: Path, name: str) -> None:
    """A scenario without a bus."""
    config, seconds, more = SIMULATED[name]
    words = ["simulate", str(CONFIGS / config), "--set", f"loop.duration_s={seconds}", *more]
    subprocess.run([*HIL, *words, *names(folder, name)], check=True, stdout=subprocess.DEVNULL)


def on_the_bus(folder: Path, name: str) -> None:
    """A scenario with the emulated drive as a process of its own."""
    config, seconds, emulator, more = BUS[name]
    channel = f"golden-{name}"
    words = [*HIL, "emulate", str(CONFIGS / config), "-c", channel, *emulator]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as drive:
        assert drive.stdout is not None
        drive.stdout.readline()
        try:
            for settings in CANOPEN.get(name, ()):
                words = ["configure", str(CONFIGS / config), "-c", channel, "--json", *settings]
                subprocess.run([*HIL, *words], check=True, stdout=subprocess.DEVNULL)
            words = ["run", str(CONFIGS / config), "-c", channel, "--duration", str(seconds), *more]
            words += ["--set", "realtime.lock_memory=false", *names(folder, name)]
            subprocess.run([*HIL, *words], check=False, stdout=subprocess.DEVNULL)
        finally:
            drive.send_signal(signal.SIGINT)


def changed(old: Path, new: Path) -> str:
    """The first tick at which two logs of one scenario differ, and how many of their fields do."""
    a, b = open_log(old, frames=False), open_log(new, frames=False)
    count = min(len(a.ticks), len(b.ticks))
    both = [f.name for f in FIELDS if f.name not in a.absent | b.absent and f.role != "time"]
    first = {}
    for name in both:
        x, y = (np.ascontiguousarray(log.ticks[name][:count]) for log in (a, b))
        rows = np.nonzero(x.view(f"u{x.itemsize}") != y.view(f"u{y.itemsize}"))[0]
        if len(rows):
            first[name] = int(rows[0])
    new_fields = sorted(a.absent - b.absent)
    text = f"; new fields: {', '.join(new_fields)}" if new_fields else ""
    text += f"; {len(a.ticks)} ticks before, {len(b.ticks)} now" if len(a.ticks) != len(b.ticks) else ""
    if not first:
        return "the same to the bit" + text
    name = min(first, key=lambda key: first[key])
    row = first[name]
    was, now = a.ticks[name][row], b.ticks[name][row]
    return f"{len(first)} fields differ, first {name} in row {row}: {was} before, {now} now{text}"


def sign(reason: str) -> None:
    """Write down what the kept logs that are not the same replay as today."""
    rows, before = [], kept.signed()
    for name, paths in kept.runs().items():
        verdict, row = kept.found(paths)
        if verdict.verdict != "same":
            row["reason"] = before.get(name, {}).get("reason", reason)
            lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in row.items())
            rows.append(f"[run.{json.dumps(name)}]\n{lines}")
    head = kept.SIGNED.read_text(encoding="utf-8").split("[run.")[0].rstrip()
    kept.SIGNED.write_text("\n\n".join([head, *rows]).rstrip() + "\n", encoding="utf-8")
    kept.write_sums()


def main() -> int:
    """Run, compare, keep or sign what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep", metavar="NAME", help="keep today's logs as generation NAME")
    parser.add_argument("--sign", metavar="REASON", help="sign what kept logs replay as today")
    parser.add_argument("scenario", nargs="*", help="these alone (default: all)")
    args = parser.parse_args()
    chosen = args.scenario or [*SIMULATED, *BUS]
    if unknown := set(chosen) - {*SIMULATED, *BUS}:
        parser.error(f"no scenario {', '.join(sorted(unknown))}; there are {', '.join([*SIMULATED, *BUS])}")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for name in chosen:
            (simulate if name in SIMULATED else on_the_bus)(folder, name)
        for paths in kept.runs().values():
            for path in paths:
                if path.name.split(".")[0] not in chosen:
                    continue
                new = folder / path.name
                what = changed(path, new) if new.is_file() else "is not written any more"
                what = "in real time, not compared" if path.stem == "inverter" and new.is_file() else what
                say(f"{path.parent.name}/{path.name}: {what}")
        if args.keep:
            shutil.copytree(folder, kept.LOGS / args.keep)
    if args.sign:
        sign(args.sign)
    if args.keep:
        kept.write_sums()
    for name, paths in kept.runs().items():
        verdict, row = kept.found(paths)
        say(f"{name} replays: {json.dumps(row)} {'; '.join(verdict.notes)}".rstrip())
    return 0


if __name__ == "__main__":
    sys.exit(main())
