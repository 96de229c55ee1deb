"""`hil identify`: step by step on the bus, each an armed run like any other, with what is known so far."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from hil.config.motor import MotorTable
from hil.config.tables import RunConfig
from hil.control.errors import ControlDesignError
from hil.control.linalg import Array
from hil.errors import ConfigError, HilError
from hil.identify.checks import breakaway, seen_in
from hil.identify.estimate import Estimate, known_k_t
from hil.identify.facts import arrivals, offsets
from hil.identify.innerloop import estimate_for
from hil.identify.motorfile import motor_of, toml_of
from hil.identify.plan import Skipped, Step, config_of, make
from hil.log.reader import open_log
from hil.runtime.loop import StopRequest
from hil.runtime.session import RunResult, run
from hil.runtime.setup import Setup, setup_of
from hil.signals import Reason, TickArray

Say = Callable[[str], None]
UNFIT: Final = {
    "fac": "commands the load machine; take a speed drive's law, cascade",
}
"""Laws whose drives can't be identified, and why."""


@dataclass(slots=True)
class Session:
    """What is known so far: the motor believed in, the runs and what became of each step.

    ``pulses`` are those of the step ``shaft``.
    """

    path: Path
    config: RunConfig
    motor: MotorTable
    runs: list[TickArray] = field(default_factory=list)
    pulses: list[TickArray] = field(default_factory=list)
    steps: list[dict[str, Any]] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    estimate: Estimate = field(default_factory=Estimate)
    offsets: list[dict[int, Array]] = field(default_factory=list)
    ended: bool = False

    @property
    def logs(self) -> list[str]:
        """The logs of the steps that ran."""
        return [str(row["log"]) for row in self.steps if row.get("log")]

    def note(self, step: Step, ticks: TickArray) -> None:
        """Take a step's run: judge it, estimate from all there is, believe what is told."""
        seen = seen_in(step, ticks)
        self.faults += seen.faults
        self.findings += [f"{step.name}: {text}" for text in seen.findings]
        (self.pulses if step.name == "shaft" else self.runs).append(ticks)
        if seen.faults:
            return
        self.estimate = estimate_for(self.config, self.motor, self.runs, self.pulses)
        self.faults += self.estimate.faults
        self.motor = motor_of(self.estimate, self.motor)

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            **self.estimate.as_dict(),
            "arrivals": arrivals(self.offsets),
            "config": str(self.path),
            "steps": self.steps,
            "logs": self.logs,
            "findings": self.findings + self.estimate.findings,
            "faults": self.faults,
            "motor_s": sum(row.get("motor_s", 0.0) for row in self.steps),
            "ok": not self.faults and self.estimate.tells,
        }


def checked(path: Path, config: RunConfig) -> None:
    """Refuse what can't be identified. Raises ConfigError."""
    if config.loop.shadow:
        raise ConfigError(
            str(path), ["loop.shadow: a shadow run sends nothing; hil identify moves the motor"]
        )
    if config.controller.kind in UNFIT:
        raise ConfigError(
            str(path), [f"controller.kind: {config.controller.kind} {UNFIT[config.controller.kind]}"]
        )


def planned(session: Session, names: Sequence[str]) -> Iterator[Step]:
    """The steps in turn, made with what is known then; those that the limits forbid are noted."""
    for name in names:
        step = make(name, session.config, session.motor)
        if isinstance(step, Skipped):
            session.steps.append({"step": name, "skipped": step.why})
            continue
        yield step


def setup_for(session: Session, step: Step) -> Setup:
    """The run of a step. Raises ConfigError that names the step."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    stem = session.config.log.name or session.path.stem
    config = config_of(session.config, step, session.motor, f"{stem}-identify-{step.name}-{stamp}")
    try:
        return setup_of(session.path, config)
    except ControlDesignError as error:
        raise HilError(f"step {step.name}: {error}") from error


def identify(
    path: Path, config: RunConfig, names: Sequence[str], say: Say, *, arm: bool = False,
    requesting: Callable[[], StopRequest] = StopRequest,
) -> Session:  # fmt: skip
    """Run the steps on the bus of the configuration. Raises HilError before anything is sent."""
    checked(path, config)
    session = Session(path, config, config.motor)
    for step in planned(session, names):
        say(f"step {step.name}, {step.seconds:.1f} s: {step.words}")
        request = requesting()
        result = run(setup_for(session, step), arm=arm, request=request)
        session.steps.append(_row(step, result, config))
        log = open_log(Path(result.log))
        ticks = log.ticks
        session.offsets.append(offsets(log))
        if not _as_planned(session, step, result, request):
            break
        session.note(step, ticks)
        if session.faults:
            break
    for row in session.steps:
        if "skipped" in row:
            say(f"step {row['step']} is left out: {row['skipped']}")
    _note_breakaway(session)
    return session


def _row(step: Step, result: RunResult, config: RunConfig) -> dict[str, Any]:
    """What became of a step."""
    ended = Reason(int(result.outcome.reason)).name.lower()
    seconds = result.outcome.ticks / config.loop.rate_hz
    return {"step": step.name, "log": result.log, "ended": ended, "motor_s": seconds}


def _as_planned(session: Session, step: Step, result: RunResult, request: StopRequest) -> bool:
    """False when a person or a fault ended the step."""
    if not result.ok:
        why = result.end.text if result.end else Reason(int(result.outcome.reason)).name.lower()
        session.faults.append(f"step {step.name} ended: {why}")
        return False
    if request.value in StopRequest.STOPS:
        session.faults.append(f"step {step.name} was stopped")
        return False
    return True


def _note_breakaway(session: Session) -> None:
    """Torque at which the shaft began to turn, from the step in which torque grows slowly."""
    ran = [row["step"] for row in session.steps if row.get("log")]
    k_t = session.estimate.parameters.get("k_t")
    if session.config.drive.takes != "voltage":
        k_t = known_k_t(session.config.k_t)
    if "spinning" in ran and k_t is not None and ran.index("spinning") < len(session.runs):
        found = breakaway(session.runs[ran.index("spinning")], k_t)
        if found is not None:
            session.estimate.parameters["breakaway"] = found


def motor_toml(session: Session) -> str:
    """The motor's file; empty when nothing was told."""
    told = any(p.told and math.isfinite(p.value) for p in session.estimate.parameters.values())
    return toml_of(session.estimate, session.motor, session.config, session.logs) if told else ""
