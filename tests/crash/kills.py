"""SIGKILL of controller, writer, emulated drive and guardian at random moments; counts at the end.

    python -m tests.crash.kills --kills 200 --seed 1

Each time: the drive ends at zero voltage (its own last words), the log reads to within a second of the kill,
`hil recover` rewrites it where it is damaged, and no process is left. Processes are forked from one that has
imported everything; several trials run side by side on buses of their own. A run that the busy host ends (by
a loop overrun, say) before the kill is no kill: it is counted as missed and the kill tried again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.config.tables import RunConfig, load_toml
from hil.log.info import info
from hil.log.reader import open_log
from hil.log.recover import recover
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState
from hil.sim.emulate import make_node
from hil.sim.simulate import simulate_ticks
from tests.crash.delay import delays, verdict
from tests.crash.processes import CONFIG, PATIENCE_S, alive, ended, forked

VICTIMS = ("controller", "writer", "emulator", "guardian")
AT_REST = ("SWITCH_ON_DISABLED", "FAULT")
SECOND_NS = 1_000_000_000
ATTEMPTS = 10


@dataclass
class Trial:
    """One kill: what was killed when, what is wrong (empty: nothing), how often the run had ended before."""

    number: int
    victim: str
    delay_s: float
    wrong: str = ""
    missed: int = 0


class TooLateError(Exception):
    """The run had ended before the kill."""


def children(pid: int) -> dict[int, str]:
    """Children of a process with their command lines; ended ones have none."""
    found = {}
    for task in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((task / "stat").read_text().rsplit(")", 1)[1].split()[1])
            if parent == pid:
                found[int(task.name)] = (task / "cmdline").read_bytes().decode(errors="replace")
        except (OSError, IndexError, ValueError):
            continue
    return found


def relatives(pid: int) -> dict[str, int]:
    """Writer and guardian of a controller."""
    mine = Path("/proc/self/cmdline").read_bytes().decode()
    found = {}
    for child, line in children(pid).items():
        if line == mine:
            found["guardian"] = child
        elif "writer" in line:
            found["writer"] = child
    return found


def until(condition: Callable[[], bool], within_s: float = PATIENCE_S) -> bool:
    """Wait until a condition holds."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


def run_trial(trial: Trial, base: Path) -> Trial:
    """A trial, again when its run had ended before the kill."""
    while trial.missed < ATTEMPTS:
        folder = base / f"{trial.number}-{trial.missed}"
        folder.mkdir()
        try:
            return attempt(trial, folder)
        except TooLateError as error:
            trial.missed += 1
            trial.wrong = f"missed {trial.missed} times, {error}"
    return trial


def attempt(trial: Trial, folder: Path) -> Trial:
    """Start drive and controller, kill, judge. Raises TooLateError."""
    trial.wrong = ""
    channel = f"kill-{os.getpid()}-{trial.number}-{trial.missed}"
    own = [
        f'bus.channel="{channel}"', f'log.folder="{folder}"', 'log.name="run"', "loop.duration_s=60.0",
        "reference.down_at_s=59.0", "realtime.fifo_priority=0", "realtime.lock_memory=false",
        "feedback.hold_ticks=300", "loop.rate_hz=500", "loop.max_gap_ticks=64", "guardian.timeout_ms=200.0",
    ]  # fmt: skip
    words = [word for setting in own for word in ("--set", setting)]
    plant = ["--plant-set", "firmware.watchdog_ms=500.0"]
    drive = forked(folder / "drive.txt", "emulate", str(CONFIG), *words, *plant)
    controller = forked(folder / "run.txt", "run", str(CONFIG), "--json", *words)
    pids = {"controller": controller, "emulator": drive}
    log = folder / "run.mcap"
    try:
        begun = until(lambda: log.is_file() and log.stat().st_size > 60_000)
        pids |= relatives(controller)
        if not begun or len(pids) < 4:
            said = " ".join((folder / "run.txt").read_text().split())
            if '"ended"' in said:
                raise TooLateError(said)
            trial.wrong = f"the run did not begin: {sorted(pids)} {said}"
            return trial
        time.sleep(trial.delay_s)
        killed_ns = time.monotonic_ns()
        try:
            os.kill(pids[trial.victim], signal.SIGKILL)
        except ProcessLookupError as error:
            raise TooLateError("the victim had ended") from error
        trial.wrong = "; ".join(judge(trial, folder, pids, killed_ns))
    finally:
        for pid in pids.values():
            if alive(pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
    return trial


def judge(trial: Trial, folder: Path, pids: dict[str, int], killed_ns: int) -> Iterator[str]:
    """Yield all that is wrong. Raises TooLateError."""
    code = ended(pids["controller"])
    if (stop_ns := stopped_at(folder / "run.mcap")) is not None and stop_ns < killed_ns:
        raise TooLateError("the run had ended by itself")
    expected = -signal.SIGKILL if trial.victim == "controller" else 1
    if code != expected:
        yield f"exit code {code} instead of {int(expected)}"
    if trial.victim != "emulator":
        time.sleep(0.7)  # guardian's stop frames, or the watchdog
        os.kill(pids["emulator"], signal.SIGTERM)
        ended(pids["emulator"])
        said = (folder / "drive.txt").read_text()
        if not any(f"state {state}," in said for state in AT_REST):
            yield f"the drive is not at rest: {said.splitlines()[-1:]}"
    if not until(lambda: not any(alive(pid) for pid in pids.values()), 10.0):
        yield f"left over: {[name for name, pid in pids.items() if alive(pid)]}"
    yield from judge_log(trial, folder / "run.mcap", killed_ns)


def stopped_at(path: Path) -> int | None:
    """When the loop began to stop."""
    ticks = open_log(path, frames=False).ticks
    stopped = ticks[ticks["reason"] != 0]
    return int(stopped["t_ns"][0] + stopped["lateness_ns"][0]) if len(stopped) else None


def judge_log(trial: Trial, path: Path, killed_ns: int) -> Iterator[str]:
    """The log holds all but the last second, and after the reason to stop only zero voltage."""
    log = open_log(path, frames=False)
    if trial.victim == "writer" and log.damage is None:
        yield "a log without its writer is not complete, and it does not say so"
    if len(log.ticks) == 0 or killed_ns - int(log.ticks["t_ns"][-1]) > SECOND_NS:
        yield f"the log ends too early: {log.damage}"
    stopped = log.ticks[log.ticks["reason"] != 0]
    if (np.abs(stopped["u_q"]) + np.abs(stopped["u_d"]) != 0).any():
        yield "voltage after the stop"
    if not (log.ticks["state"] == int(DriveState.OPERATION_ENABLED)).any():
        yield "the drive was never in operation"
    if log.damage is not None:
        mended = path.with_suffix(".recovered.mcap")
        recover(path, mended)
        if info(mended).counts.get("/tick") != len(log.ticks):
            yield "hil recover lost ticks"


def warm_up() -> None:
    """Load every kernel before anything is forked."""
    simulate_ticks(load_setup(CONFIG, Overrides(settings=("loop.duration_s=0.05",))))
    node, link, _ = make_node(CONFIG, load_toml(CONFIG, RunConfig), [])
    node.warm_up()
    link.close()


def worker(trials: list[Trial], base: Path) -> tuple[int, int]:
    """Trials one after the other in a forked process: its pid, and the pipe that it reports to in the end."""
    ours, theirs = os.pipe()
    pid = os.fork()
    if pid == 0:
        done = []
        try:
            done.extend(run_trial(trial, base).__dict__ for trial in trials)
        except BaseException as error:  # noqa: BLE001 - the parent judges
            done.append({"number": -1, "victim": "worker", "delay_s": 0.0, "wrong": repr(error)})
        with os.fdopen(theirs, "wb") as pipe:
            pipe.write(json.dumps(done).encode())
        os._exit(0)
    os.close(theirs)
    return pid, ours


def report_of(pid: int, ours: int) -> list[Trial]:
    """What a worker reports."""
    with os.fdopen(ours, "rb") as pipe:
        said = pipe.read()
    os.waitpid(pid, 0)
    return [Trial(**one) for one in json.loads(said)]


def kills(count: int, seed: int, side_by_side: int = 3) -> list[Trial]:
    """Kill ``count`` times; victims in turn, moments by the seed."""
    dice = random.Random(seed)
    trials = [Trial(k, VICTIMS[k % len(VICTIMS)], dice.uniform(0.0, 1.5)) for k in range(count)]
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        shares = [trials[k::side_by_side] for k in range(min(side_by_side, count))]
        workers = [worker(share, Path(folder)) for share in shares]
        done = [trial for one in workers for trial in report_of(*one)]
    return sorted(done, key=lambda trial: trial.number)


def main() -> int:
    """Command line: prints every failure and the counts; exit code 1 for any failure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--delays", type=int, help="kills that are timed (default: as many as --kills)")
    args = parser.parse_args()
    begin = time.monotonic()
    done = kills(args.kills, args.seed)
    bad = [trial for trial in done if trial.wrong]
    for trial in bad:
        print(f"kill {trial.number} of the {trial.victim} after {trial.delay_s:.2f} s: {trial.wrong}")
    good = Counter(trial.victim for trial in done if not trial.wrong)
    counts = ", ".join(f"{name} {good[name]}" for name in VICTIMS)
    missed = sum(trial.missed for trial in done)
    print(
        f"{len(done) - len(bad)} of {len(done)} kills survived ({counts}), "
        f"seed {args.seed}, {time.monotonic() - begin:.0f} s; {missed} runs ended before the kill"
    )
    count = args.kills if args.delays is None else args.delays
    with tempfile.TemporaryDirectory() as folder:
        in_time, found = verdict(delays(count, args.seed, Path(folder)), count) if count else (True, "")
    print(found)
    return 1 if bad or len(done) != args.kills or not in_time else 0


if __name__ == "__main__":
    sys.exit(main())
