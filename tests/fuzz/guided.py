"""Fuzzing guided by coverage, with atheris: inputs that reach new code are kept and changed further.

    NUMBA_DISABLE_JIT=1 python -m tests.fuzz.guided --seconds 60

Needs the optional group ``fuzz``. Each target runs in a process of its own, since libFuzzer ends its process;
the compiler is off, so that coverage sees into the kernels. Prints the number of inputs tried.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

NAMES = (
    *("config", "plant", "faults", "dbc", "log"),
    *("rec-log", "rec-asc", "rec-trc", "rec-blf", "rec-mf4"),
    *("codec", "client", "guard", "tick"),
)


def run_target(name: str, work: Path, seconds: int, seed: int) -> None:
    """Instrument the project's packages and give the process to libFuzzer."""
    import atheris

    with atheris.instrument_imports(include=["hil", "drivers", "firmware_model"]):
        from tests.fuzz.inputs import targets
    warnings.simplefilter("ignore", RuntimeWarning)  # numpy scalars warn where compiled code does not
    target, corpus = targets(work)[name], work / "corpus"
    corpus.mkdir()
    for number, raw in enumerate(target.seeds):
        (corpus / str(number)).write_bytes(raw)
    longest = max((2 * len(raw) for raw in target.seeds), default=600)
    options = [
        f"-max_total_time={seconds}",
        f"-seed={seed}",
        f"-max_len={longest}",
        "-len_control=0",
        "-print_final_stats=1",
    ]
    atheris.Setup(
        [sys.argv[0], *options, f"-artifact_prefix={work}/", "-timeout=60", str(corpus)], target.take
    )
    atheris.Fuzz()


def report(name: str, seconds: int, seed: int) -> bool:
    """Run one target in its process; print the count and, when it failed, the failing input."""
    with tempfile.TemporaryDirectory() as work:
        command = [sys.executable, "-m", "tests.fuzz.guided", "--target", name, "--work", work]
        command += ["--seconds", str(seconds), "--seed", str(seed)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        said = done.stdout + done.stderr
        units = re.search(r"number_of_executed_units: (\d+)", said) or re.search(r"Done (\d+) runs", said)
        edges = re.findall(r"cov: (\d+)", said)
        count = f"{units[1] if units else '?'} inputs, {edges[-1] if edges else '?'} edges reached"
        print(f"{name:8} {count}{'' if done.returncode == 0 else ' FAILED'}", flush=True)
        if done.returncode:
            print(
                done.stdout[-3000:],
                done.stderr[-1000:],
                *(f"input: {p.read_bytes().hex()}" for p in Path(work).glob("crash-*")),
            )
        return done.returncode == 0


def main() -> int:
    """Run every target for its seconds and print the counts."""
    parser = argparse.ArgumentParser(description="fuzz with coverage as the guide")
    parser.add_argument("--seconds", type=int, default=60, help="for each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=NAMES)
    parser.add_argument("--target", choices=NAMES, help=argparse.SUPPRESS)
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.target:
        run_target(args.target, args.work, args.seconds, args.seed)
        return 0
    chosen = [args.only] if args.only else NAMES
    failed = [name for name in chosen if not report(name, args.seconds, args.seed)]
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
