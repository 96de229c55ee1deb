"""Fuzzing: seeded inputs against everything that reads bytes of others, the guard, and the whole tick.

    python -m tests.fuzz.inputs --seconds 20 --seed 1

Files are mutated from real ones; the other targets draw their values from the input's bytes. Here the seed
names an input; :mod:`tests.fuzz.guided` lets coverage choose them. Prints the number of inputs tried.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from hil.config.tables import load_toml
from hil.faults.matrix import Matrix
from tests.fuzz import client, codec, guard
from tests.fuzz.files import (
    Take,
    read_config,
    read_database,
    read_log,
    read_matrix,
    read_plant,
    read_recording,
    reads,
)
from tests.fuzz.tick import whole_tick
from tests.logfiles import some_frames, some_ticks, write_log

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
CORPUS = Path(__file__).resolve().parents[1] / "corpus"
RECORDINGS = ("log", "asc", "trc", "blf", "mf4")
LONGEST = 600
WORDS = (b"-1", b"0", b"1e400", b"nan", b"9" * 20, b"[", b'"', b"\x00", b"../../x", b"\xff\xfe", b"{}")


@dataclass(frozen=True, slots=True)
class Target:
    """What takes an input, and the files that inputs are mutated from; without one they are random bytes."""

    take: Take
    seeds: tuple[bytes, ...] = ()

    def input(self, rng: random.Random) -> bytes:
        if self.seeds:
            return mutated(rng.choice(self.seeds), rng)
        return rng.randbytes(rng.randrange(1, LONGEST))


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


def shipped(*names: str) -> tuple[bytes, ...]:
    return tuple((CONFIGS / name).read_bytes() for name in names)


def recorded(kind: str) -> tuple[bytes, ...]:
    """The corpus's recordings of one format."""
    return tuple(path.read_bytes() for path in sorted(CORPUS.glob(f"*.{kind}")))


def targets(work: Path) -> dict[str, Target]:
    """Return every target by name; ``work`` is a folder for the files that are read."""
    log = work / "seed.mcap"
    log.unlink(missing_ok=True)
    write_log(log, some_ticks(200), some_frames(400), block=50)
    return {
        "config": Target(reads(work / "run.toml", read_config), shipped("demo.toml", "inverter.toml")),
        "plant": Target(
            reads(work / "plant.toml", read_plant), (*shipped("plants/demo.toml"), scripted_plant())
        ),
        "faults": Target(reads(work / "faults.toml", read_matrix), shipped("faults.toml")),
        "dbc": Target(
            reads(work / "drive.dbc", read_database), shipped("drives/hil_pmsm.dbc", "drives/inverter_fd.dbc")
        ),
        "log": Target(reads(work / "run.mcap", read_log), (log.read_bytes(),)),
        **{
            f"rec-{kind}": Target(reads(work / f"rec.{kind}", read_recording), recorded(kind))
            for kind in RECORDINGS
        },
        "codec": Target(codec.take),
        "client": Target(client.take),
        "guard": Target(guard.take),
        "tick": Target(whole_tick()),
    }


def scripted_plant() -> bytes:
    """The demo's plant with every fault of the shipped matrix in its script."""
    rows = load_toml(CONFIGS / "faults.toml", Matrix).row
    script = [setting for row in rows for setting in row.plant_settings() if setting.startswith("fault=")]
    faults = ", ".join(setting.removeprefix("fault=")[1:-1] for setting in script)
    return f"fault = [{faults}]\n".encode() + shipped("plants/demo.toml")[0]


def fuzz(name: str, target: Target, seed: int, seconds: float, most: int) -> int:
    """Run a target until its time or count is over; return the count. A failure names its input's seed."""
    end, count = time.monotonic() + seconds, 0
    while count < most and time.monotonic() < end:
        own = f"{name}/{seed}/{count}"
        try:
            target.take(target.input(random.Random(own)))
        except Exception as error:
            raise AssertionError(f"input {own}: {type(error).__name__}: {error}") from error
        count += 1
    return count


def run(name: str, target: Target, seed: int, seconds: float) -> bool:
    """Run one target for its seconds and print the count; False when it failed."""
    try:
        print(f"{name:8} {fuzz(name, target, seed, seconds, 1 << 62)} inputs", flush=True)
    except AssertionError as error:
        print(f"{name:8} FAILED {error}", flush=True)
        return False
    return True


def main() -> int:
    """Run every target for its seconds and print the counts."""
    parser = argparse.ArgumentParser(description="fuzz what reads bytes of others, the guard and the tick")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="name of one target")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        chosen = {k: v for k, v in targets(Path(work)).items() if args.only in (None, k)}
        failed = [name for name, each in chosen.items() if not run(name, each, args.seed, args.seconds)]
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
