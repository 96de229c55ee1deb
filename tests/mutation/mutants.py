"""Mutation testing of what keeps a run safe: change one thing, count what its tests miss.

    NUMBA_DISABLE_JIT=1 python -m tests.mutation.mutants [--sample 60 --seed 1]

Tests are collected once. Each mutant runs in a forked child in which the changed function's code takes the
place of the original's, so that every importer sees it; the child ends at the first test that fails, and
tests that noticed much so far go first. A child that crashes or does not end has noticed its mutant, too.
Tests with drawn inputs are left out, so that the score does not depend on luck. Mutants that change no
behaviour stand in ``equivalent.txt`` with the reason; any other survivor makes the exit code 1.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import mmap
import os
import random
import resource
import sys
import time
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest

from tests.mutation.operators import ROOT, Mutant, mutants

SAFETY = (
    "test_guard.py",
    "test_guard_limits.py",
    "test_supervisor_rules.py",
    "test_supervisor.py",
    "test_guard_time.py",
    "test_guard_current.py",
)
JUDGES = {
    "hil/tick/guard.py": SAFETY,
    "hil/tick/supervisor.py": SAFETY,
    "hil/runtime/guardian.py": ("test_guardian.py",),
    "hil/tick/setpoint.py": ("test_setpoint.py",),
}
"""The tests of tests/unit that judge the mutants of a file."""
FILES = tuple(JUDGES)
PROCESSES = ("_serve", "guardian", "_await_ready", "_await_end", "Rights.acquire", "START_S", "END_S")
"""What forks, and the fork: tests/process/test_guardian.py tests that with processes, too slow for this."""
EQUIVALENT = Path(__file__).with_name("equivalent.txt")
BROKEN = 70
"""Exit status of a child that failed outside the tests."""
CPU_LIMIT_S = 60
"""Processor time of a child: a mutant that loops for ever has been noticed."""


def explained() -> dict[str, str]:
    """The equivalent mutants: key and reason, two lines each; blank lines and comments between."""
    lines = EQUIVALENT.read_text(encoding="utf-8").splitlines()
    lines = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    return dict(zip(lines[::2], lines[1::2], strict=True))


def put_in_place(mutant: Mutant) -> None:
    """Give the original function the mutant's code, or the module the mutant's constant."""
    module = importlib.import_module(mutant.file[:-3].replace("/", "."))
    code = compile(ast.Module([mutant.tree], []), f"<mutant of {mutant.name}>", "exec")
    names: dict[str, Any] = {}
    exec(code, module.__dict__, names)  # noqa: S102 - the repository's own source, with one change
    made = names[mutant.name.rpartition(".")[2]]
    if not isinstance(made, FunctionType):
        setattr(module, mutant.name, made)
        return
    original: Any = reduce(getattr, mutant.name.split("."), module)
    assert isinstance(original, FunctionType), "run it with NUMBA_DISABLE_JIT=1"
    original.__code__ = made.__code__


def shared(count: int) -> Any:
    """Whole numbers that forked processes share."""
    return memoryview(mmap.mmap(-1, 8 * count)).cast("q")


class Hunt:
    """A plugin of pytest that runs the collected tests once for every mutant, not once."""

    def __init__(self, hunted: list[Mutant], workers: int) -> None:
        self.hunted, self.workers = hunted, workers
        self.alive: list[Mutant] = []
        self.green = False

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Take the place of pytest's own loop."""
        self._noticed, self._took_ns = shared(len(session.items)), shared(len(session.items))
        self._caught = shared(len(self.hunted))
        self.green = self._child(session, None)
        if self.green:
            pids = [self._worker(session, share) for share in range(self.workers)]
            for pid in pids:
                os.waitpid(pid, 0)
            self.alive = [mutant for i, mutant in enumerate(self.hunted) if not self._caught[i]]
        return True

    def _worker(self, session: pytest.Session, share: int) -> int:
        pid = os.fork()
        if pid == 0:
            for i in range(share, len(self.hunted), self.workers):
                self._caught[i] = not self._child(session, self.hunted[i])
                if not self._caught[i]:
                    print(f"not noticed: line {self.hunted[i].line} of {self.hunted[i].key}", flush=True)
            os._exit(0)
        return pid

    def _child(self, session: pytest.Session, mutant: Mutant | None) -> bool:
        """Run the tests in a forked child; True when all are green."""
        pid = os.fork()
        if pid:
            status = os.waitpid(pid, 0)[1]
            assert os.waitstatus_to_exitcode(status) != BROKEN, "a mutant could not be put in place"
            return status == 0
        if mutant is not None:
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S))
        noticed = BROKEN
        try:
            if mutant is not None:
                put_in_place(mutant)
            noticed = self._run(session, mutant)
        finally:
            os._exit(noticed)

    def _run(self, session: pytest.Session, mutant: Mutant | None) -> int:
        """Run the tests, those that noticed most mutants first, then quick before slow ones; 0 when green."""
        judges = [i for i, item in enumerate(session.items) if mutant is None or judged(item, mutant)]
        order = sorted(judges, key=lambda i: (-self._noticed[i], self._took_ns[i]))
        items = [session.items[i] for i in order]
        for i, item, following in zip(order, items, [*items[1:], None], strict=True):
            begun = time.process_time_ns()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            self._took_ns[i] = time.process_time_ns() - begun
            if session.testsfailed:
                self._noticed[i] += 1
                return 1
        return 0


def judged(item: pytest.Item, mutant: Mutant) -> bool:
    """True when this test is one for the mutant's file."""
    return item.path.name in JUDGES[mutant.file]


def chosen(files: Sequence[str], sample: int, seed: int) -> list[Mutant]:
    """All mutants, or as many of them, drawn with the seed."""
    found = [mutant for file in files for mutant in mutants(file) if mutant.name not in PROCESSES]
    return random.Random(seed).sample(found, min(sample, len(found))) if sample else found


def main() -> int:
    """Print the score and every survivor; 1 when one is neither noticed nor explained."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sample", type=int, default=0, help="only so many, drawn with the seed")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--file", choices=FILES, help="mutants of this one alone")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        parser.error("set NUMBA_DISABLE_JIT=1: compiled code has no source to change")
    os.chdir(ROOT)
    files = (args.file,) if args.file else FILES
    hunt, begun = Hunt(chosen(files, args.sample, args.seed), args.workers), time.monotonic()
    skipped = "not random and not whatever and not simulated"
    quiet = ["-o", "addopts=", "-p", "no:terminal", "-p", "no:cacheprovider"]
    tests = sorted({f"tests/unit/{name}" for file in files for name in JUDGES[file]})
    pytest.main([*quiet, "-x", "-k", skipped, *tests], [hunt])
    if not hunt.green:
        print("the tests are not green without a mutant")
        return 1
    return report(hunt, files, time.monotonic() - begun)


def report(hunt: Hunt, files: Sequence[str], seconds: float) -> int:
    """Print what became of the mutants."""
    reasons = explained()
    unexplained = [mutant for mutant in hunt.alive if mutant.key not in reasons]
    equivalent = len(hunt.alive) - len(unexplained)
    counted = len(hunt.hunted) - equivalent
    print(f"{len(hunt.hunted)} mutants of {', '.join(files)} in {seconds:.0f} s: {equivalent} equivalent;")
    print(f"{counted - len(unexplained)} of the other {counted} noticed")
    for mutant in unexplained:
        print(f"SURVIVED line {mutant.line} of {mutant.key}")
    return 1 if unexplained else 0


if __name__ == "__main__":
    sys.exit(main())
