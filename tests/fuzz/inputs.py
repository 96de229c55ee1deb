"""Fuzzing: seeded mutations of real inputs against everything that reads bytes of others, and the whole tick.

    python -m tests.fuzz.inputs --seconds 20 --seed 1

No coverage guides it; the mutations are random and the seed names them. For each target: an input is either
taken or refused with one of the project's own errors. Prints the number of inputs tried for each target.
"""

from __future__ import annotations

import argparse
import random
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drivers.codec import Database
from drivers.errors import DriverError
from hil.config import RunConfig, load_toml
from hil.design import Machine, WireFacts, build
from hil.errors import HilError
from hil.log.info import info
from hil.log.reader import open_log
from hil.log.recover import recover
from hil.signals import DriveState, Request, RxFlag, new_ticks
from tests.logfiles import some_frames, some_ticks, write_log

ROOT = Path(__file__).resolve().parents[2]
DBC = ROOT / "configs" / "drives" / "hil_pmsm.dbc"
CONFIG = ROOT / "configs" / "demo.toml"
WIRE = WireFacts(0.01, 0.01, 16, (0.01, 0.001, 0.01), 327.67)
WORDS = (
    b"-1",
    b"0",
    b"1e400",
    b"nan",
    b"99999999999999999999",
    b"[",
    b'"',
    b"\x00",
    b"../../x",
    b"\xff\xfe",
    b"{}",
)
FIELDS = (
    "w",
    "i_q",
    "i_d",
    "v_dc",
    "temperature_motor",
    "temperature_inverter",
    "w_ref",
    "dw_ref",
    "i_q_ref_in",
)
Trial = Callable[[random.Random], None]


def mutated(raw: bytes, rng: random.Random) -> bytes:
    """Return ``raw`` with one to four changes: flipped, cut, doubled, moved or replaced pieces."""
    data = bytearray(raw)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        size = rng.choice((1, 2, 4, 8, 40, 300))
        kind = rng.randrange(6)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[at : at + size] = rng.randbytes(size)
        elif kind == 2:
            del data[at : at + size]
        elif kind == 3:
            data[at:at] = data[at : at + size]
        elif kind == 4:
            data[at:at] = rng.choice(WORDS)
        elif rng.random() < 0.2:
            del data[at:]
    return bytes(data)


@contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def file_trial(seed_file: Path, name: str, take: Callable[[Path], object]) -> Trial:
    """Return a trial that gives mutated copies of a file to ``take``; only own errors may come."""
    raw = seed_file.read_bytes()

    def trial(rng: random.Random) -> None:
        with folder() as here:
            path = here / name
            path.write_bytes(mutated(raw, rng))
            try:
                take(path)
            except (HilError, DriverError) as refused:
                assert str(refused), "a refusal says why"

    return trial


def read_log(path: Path) -> None:
    """Read, list and recover one log."""
    log = open_log(path)
    assert len(log.ticks) < 100_000
    info(path)
    recover(path, path.with_name("out.mcap"))


def use_database(path: Path) -> None:
    Database(path)


def decode(database: Database) -> Trial:
    """Give random and mutated payloads to every message's decoder."""
    messages = [database.message(name) for name in ("FEEDBACK", "STATUS", "COMMAND")]

    def trial(rng: random.Random) -> None:
        message = rng.choice(messages)
        try:
            values = message.decode(rng.randbytes(rng.choice((message.length, rng.randrange(65)))))
        except DriverError:
            return
        assert all(isinstance(value, float | int) for value in values.values())

    return trial


def any_float(rng: random.Random) -> float:
    """Return a float64 of random bits, or a likely one."""
    if rng.random() < 0.3:
        return float(struct.unpack("<d", rng.randbytes(8))[0])
    return rng.choice((0.0, -0.0, 5e-324, 1e308, float("nan"), float("inf"), rng.gauss(0.0, 30.0)))


def whole_tick(machine: Machine) -> Trial:
    """Enable the drive, then give every input of the tick random bits: what leaves is finite and limited."""

    def trial(rng: random.Random) -> None:
        fresh, ticks = machine.fresh(), new_ticks()
        t: Any = ticks[0]
        t["v_dc"], t["temperature_motor"], t["temperature_inverter"] = 540.0, 25.0, 25.0
        for state in (DriveState.SWITCH_ON_DISABLED, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED):
            t["gap"], t["rx_flags"], t["request"] = 1, int(RxFlag.FRESH), int(Request.ARM)
            t["drive_state"] = int(state)
            fresh.step(ticks)
        before = (0.0, 0.0)
        for _ in range(12):
            scramble(t, rng)
            fresh.step(ticks)
            before = check_command(t, before)

    return trial


def scramble(t: Any, rng: random.Random) -> None:
    """Set the inputs of one tick; most ticks stay in operation, so that the law is met too."""
    t["gap"] = rng.choice((1, 1, 1, 2, 30, rng.randrange(1, 1 << 16)))
    t["rx_flags"] = int(RxFlag.FRESH) if rng.random() < 0.7 else rng.randrange(1 << 12)
    t["drive_state"] = int(DriveState.OPERATION_ENABLED) if rng.random() < 0.8 else rng.randrange(8)
    t["echo"], t["request"] = (
        rng.randrange(256),
        int(Request.ARM) if rng.random() < 0.95 else rng.randrange(6),
    )
    for name in rng.sample(FIELDS, rng.randrange(len(FIELDS))):
        t[name] = any_float(rng)


def check_command(t: Any, before: tuple[float, float]) -> tuple[float, float]:
    """Check one tick's command: finite, within circle and step, zero outside operation."""
    u_q, u_d, T_L = float(t["u_q"]), float(t["u_d"]), float(t["T_L"])
    assert np.isfinite([u_q, u_d, T_L]).all(), (u_q, u_d, T_L)
    assert np.hypot(u_q, u_d) <= LIMITS.u_max_v + 0.01 and abs(T_L) <= LIMITS.T_L_max_n_m + 0.005
    if t["state"] != DriveState.OPERATION_ENABLED:
        assert (u_q, u_d, T_L) == (0.0, 0.0, 0.0), DriveState(int(t["state"]))
    else:
        step = LIMITS.du_max_v + 0.011
        assert abs(u_q - before[0]) <= step and abs(u_d - before[1]) <= step, (before, u_q, u_d)
    return u_q, u_d


LIMITS = load_toml(CONFIG, RunConfig).limits


def targets(work: Path) -> dict[str, Trial]:
    """Return every target by name; ``work`` holds the log that is mutated."""
    log = work / "seed.mcap"
    write_log(log, some_ticks(200), some_frames(400), block=50)
    return {
        "config": file_trial(CONFIG, "run.toml", lambda path: load_toml(path, RunConfig)),
        "dbc": file_trial(DBC, "drive.dbc", use_database),
        "log": file_trial(log, "run.mcap", read_log),
        "codec": decode(Database(DBC)),
        "tick": whole_tick(build(load_toml(CONFIG, RunConfig), WIRE)),
    }


def fuzz(name: str, trial: Trial, seed: int, seconds: float, most: int) -> int:
    """Run a target until its time or count is over; return the count. A failure names its input's seed."""
    end, count = time.monotonic() + seconds, 0
    while count < most and time.monotonic() < end:
        own = f"{name}/{seed}/{count}"
        try:
            trial(random.Random(own))
        except Exception as error:
            raise AssertionError(f"input {own}: {type(error).__name__}: {error}") from error
        count += 1
    return count


def main() -> int:
    """Run every target for its seconds and print the counts."""
    parser = argparse.ArgumentParser(description="fuzz what reads bytes of others, and the whole tick")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="name of one target")
    args = parser.parse_args()
    failed = 0
    with folder() as work:
        for name, trial in targets(work).items():
            if args.only in (None, name):
                try:
                    print(
                        f"{name:8} {fuzz(name, trial, args.seed, args.seconds, 1 << 62)} inputs", flush=True
                    )
                except AssertionError as error:
                    failed += 1
                    print(f"{name:8} FAILED {error}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
