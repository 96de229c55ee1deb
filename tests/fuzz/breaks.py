"""Deliberate breaks of guard and client: does the fuzzing notice them?

    NUMBA_DISABLE_JIT=1 python -m tests.fuzz.breaks [--inputs 400]

Each break is put in place in a forked child, which then tries seeded inputs until one fails. Prints after how
many inputs; exit code 1 when a break was not noticed.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import warnings
from collections.abc import Callable
from typing import Any

import drivers.client
import drivers.wire
from tests.fuzz import client, guard
from tests.fuzz.files import Take
from tests.mutation.mutants import put_in_place
from tests.mutation.operators import mutants

# of hil/tick/guard.py: function, text of the line, what becomes what
GUARD = (
    ("guard_command", "if not (math.isfinite(u_q)", "if not", "if False:"),
    ("guard_command", 'if t["state"] != DriveState', "if t", "if False:"),
    ("guard_command", "if norm > limit", "if norm", "if False:"),
    ("guard_command", "if share < 1.0", "if share", "if False:"),
    ("guard_command", "load = min(max(", "min(", "max("),
    ("guard_command", "ratio = limit / norm", "limit / norm", "limit * norm"),
    ("guard_command", "flags |= GuardFlag.DENORMAL", "flags |=", "pass"),
    ("guard_command", "flags |= GuardFlag.LOAD_TORQUE", "flags |=", "pass"),
    ("guard_command", "flags |= GuardFlag.APPLIED_DEVIATES", "flags |=", "pass"),
    ("limit_step", "return min(max(", "max(", "min("),
    ("step_share", "most = max(", "max(", "min("),
    ("to_wire", "np.rint(value / lsb)", "np.rint", "np.rint(value / lsb) * lsb - 0.0"),
    ("is_denormal", "return value != 0.0", "value != 0.0 and", "value != 0.0"),
    ("voltage_limit", 'if s["run_ticks"]', "if s", "if True:"),
    ("deviates", "far = dq", "dq * dq + dd * dd >", "dq * dq + dd * dd < "),
    ("write_command", 's["u_q"], s["u_d"]', "s[", "pass"),
    ("persistent_excess", 's["clamped"] = ', "s[", "pass"),
    ("persistent_excess", 'return Reason.GUARD_PERSISTENT', "s['clamped'] >=", "s['clamped'] > "),
)  # fmt: skip


def guard_breaks() -> dict[str, Callable[[], None]]:
    """Each as a function that puts it in place. One that the source has no place for any more is named."""
    lines = (client.DBC.parents[2] / "hil/tick/guard.py").read_text(encoding="utf-8").splitlines()
    found: dict[str, Callable[[], None]] = {}
    everything = mutants("hil/tick/guard.py")
    for name, line, before, after in GUARD:
        fits = [
            each
            for each in everything
            if each.name == name
            and line in lines[each.line - 1]
            and each.before.startswith(before)
            and each.after.startswith(after)
        ]
        assert fits, f"no such mutant of {name}: {line} | {before} => {after}"
        found[f"{name}: {fits[0].before} => {fits[0].after}"] = lambda each=fits[0]: put_in_place(each)  # type: ignore[misc]
    return found


def unchecked() -> None:
    """Apply frames with a wrong CRC."""
    drivers.wire.is_valid = lambda raw, m: True


def by_halves() -> None:
    """Apply the first value of a frame before it is judged."""
    whole = drivers.wire.take

    def take(*args: Any) -> Any:
        raw, messages, signals, words, tick = (args[place] for place in (0, 1, 2, 5, 6))
        index = drivers.wire.find(raw, messages)
        if index >= 0 and int(raw[4]) == messages[index]["length"]:
            signal = signals[messages[index]["first"] + (messages[index]["modulus"] > 0)]
            value = drivers.wire.phys_of(raw, messages[index]["length"], signal, words)
            drivers.wire.put(tick, signal, value)
        return whole(*args)

    drivers.client.take = take  # type: ignore[attr-defined]


def late_applied() -> None:
    """Apply what came too late for its tick."""
    whole = drivers.wire.take
    drivers.client.take = lambda *args: whole(*args[:9], False, args[10])  # type: ignore[attr-defined]


CLIENT = {f.__doc__ or "": f for f in (unchecked, by_halves, late_applied)}


def noticed_after(put: Callable[[], None], name: str, take: Take, inputs: int) -> int:
    """Number of inputs until the break was noticed, 0 when it was not, in a forked child."""
    read, write = os.pipe()
    if os.fork() == 0:
        count = 0
        try:
            put()
            count = first_failure(name, take, inputs)
        finally:
            os.write(write, f"{count}".encode())
            os._exit(0)
    os.close(write)
    with os.fdopen(read) as said:
        count = int(said.read())
    os.wait()
    return count


def first_failure(name: str, take: Take, inputs: int) -> int:
    for count in range(1, inputs + 1):
        rng = random.Random(f"{name}/breaks/{count}")
        try:
            take(rng.randbytes(rng.randrange(1, 600)))
        except Exception:  # noqa: BLE001 - whatever it is, it was noticed
            return count
    return 0


def main() -> int:
    """Print each break and after how many inputs it was noticed."""
    parser = argparse.ArgumentParser(description="are deliberate breaks noticed by the fuzzing?")
    parser.add_argument("--inputs", type=int, default=400, help="most inputs for each break")
    args = parser.parse_args()
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        parser.error("set NUMBA_DISABLE_JIT=1: compiled code has no source to change")
    warnings.simplefilter("ignore", RuntimeWarning)  # numpy scalars warn where compiled code does not
    trials = [("guard", guard.take, each) for each in guard_breaks().items()]
    trials += [("client", client.take, each) for each in CLIENT.items()]
    missed = 0
    for name, take, (text, put) in trials:
        count = noticed_after(put, name, take, args.inputs)
        missed += count == 0
        print(f"{name:6} {f'input {count}' if count else 'NOT NOTICED':12} {text}", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
