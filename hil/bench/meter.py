"""Processor time of each phase of a tick: `hil` with a meter around the calls between its parts.

    python -m hil.bench.meter REPORT run CONFIG ...   # as `hil run CONFIG ...`; REPORT gets a JSON object

The stamps of a log say when a phase ended, waiting included; this says what it took of the processor: the
thread's own clock is read at each border of :data:`PHASES`. What the meter itself takes is measured first and
taken off. The parts are named by text and found when the meter is installed; it is no way to drive a motor.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Final

LOOP: Final = "loop"
PHASES: Final[dict[str, tuple[str, ...]]] = {
    "sleep": ("hil.clock:RealClock.sleep_until",),
    "sync, receive, check, decode": tuple(f"drivers.client:DriveClient.{x}" for x in ("exchange", "receive")),
    "control and guard": ("hil.design:Machine.looped()",),
    "encode, send": ("drivers.client:DriveClient.send",),
    "record": ("hil.log.recorder:Recorder.tick", "hil.log.recorder:Recorder.frames"),
    "guardian": tuple(f"hil.guardian:GuardedDrive.{x}" for x in ("exchange", "receive", "send")),
}
"""Where each phase is; what is in none of them is ``loop``. A method with () makes
what is called; one that is not there is left out."""
Function = Callable[..., Any]


class Meter:
    """Processor time of the thread by phase, each without the phases that it calls."""

    def __init__(self, names: list[str]) -> None:
        self.names = names
        self.ns, self.calls, self.made = [0] * len(names), [0] * len(names), [0] * len(names)
        self._at = self._last = 0

    def wrap(self, index: int, function: Function) -> Function:
        """The function, metered; the clock is read twice at each border, so that the sums fall between."""
        clock, ns, calls, made = time.thread_time_ns, self.ns, self.calls, self.made

        def metered(*args: Any) -> Any:
            now = clock()
            outer = self._at
            ns[outer] += now - self._last
            made[outer] += 1
            calls[index] += 1
            self._at = index
            self._last = clock()
            try:
                return function(*args)
            finally:
                now = clock()
                ns[index] += now - self._last
                self._at = outer
                self._last = clock()

        return metered

    def wrap_made(self, index: int, factory: Function) -> Function:
        """A factory whose products are metered."""
        return lambda *args: self.wrap(index, factory(*args))

    def start(self) -> None:
        """Begin at zero, outside every phase."""
        for sums in (self.ns, self.calls, self.made):
            sums[:] = [0] * len(self.names)
        self._at, self._last = 0, time.thread_time_ns()

    def stop(self) -> None:
        """Close the last sum."""
        self.ns[self._at] += time.thread_time_ns() - self._last

    def sums(self, inner_ns: float, outer_ns: float) -> dict[str, float]:
        """Each phase's time [ns] without what the meter took in it, given its cost inside and outside."""
        rows = zip(self.names, self.ns, self.calls, self.made, strict=True)
        return {name: ns - calls * inner_ns - made * outer_ns for name, ns, calls, made in rows}


def own_cost(count: int = 5000) -> tuple[float, float]:
    """What the meter takes [ns] inside a metered call and around it, over a function that does nothing."""
    meter = Meter([LOOP, "nothing"])
    metered = meter.wrap(1, lambda *_: None)
    meter.start()
    for _ in range(count):
        metered(0)
    meter.stop()
    return meter.ns[1] / count, meter.ns[0] / count


def install(meter: Meter) -> None:
    """Put the meter around every part that there is."""
    for index, name in enumerate(meter.names):
        for target in PHASES.get(name, ()):
            module, _, path = target.partition(":")
            owner_name, _, method = path.removesuffix("()").partition(".")
            owner = getattr(import_module(module), owner_name)
            if hasattr(owner, method):
                put = meter.wrap_made if path.endswith("()") else meter.wrap
                setattr(owner, method, put(index, getattr(owner, method)))


def run_metered(report: Path, words: list[str]) -> int:
    """Run `hil WORDS` with the meter in it; ``report`` gets each phase's processor time a tick [ns]."""
    from hil import cli
    from hil.loop import Loop, Outcome

    inner, outer = own_cost()
    meter, plain = Meter([LOOP, *PHASES]), Loop.run
    install(meter)

    def run(self: Loop) -> Outcome:
        meter.start()
        try:
            outcome = plain(self)
        finally:
            meter.stop()
        sums = meter.sums(inner, outer)
        report.write_text(json.dumps({name: ns / outcome.ticks for name, ns in sums.items()}))
        return outcome

    Loop.run = run  # type: ignore[method-assign]
    return cli.main(words)


if __name__ == "__main__":
    sys.exit(run_metered(Path(sys.argv[1]), sys.argv[2:]))
