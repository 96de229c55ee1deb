"""Run configuration: typed, frozen, refuses unknown keys, names every mistake at once.

Units stand in the key names (``rate_hz``, ``i_max_a``). Paths are relative to the file they stand in.
What the values mean physically is left to the modules that use them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator

from hil.config.drive import CanopenTable, Command, DriveTable, EmulatorTable, Takes, takes_of
from hil.config.law import ControllerTable, ObserverTable, cascade
from hil.config.limits import CriteriaTable, FaultsTable, FeedbackTable, LimitsTable
from hil.config.loop import BusTable, GuardianTable, LogTable, LoopTable, RealtimeTable
from hil.config.mistakes import describe
from hil.config.motor import MotorTable
from hil.config.nodes import chosen
from hil.config.reference import ReferenceTable, SetpointTable, StopTable
from hil.config.table import Table, included
from hil.config.toml import override, read_toml
from hil.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)


def _includer(base: Path | None) -> Callable[[str], dict[str, Any]]:
    """Return what reads a TOML file relative to ``base``; without one no file is opened."""

    def include(name: str) -> dict[str, Any]:
        if base is None:
            raise ValueError("must be a table: a config inside a log opens no file")
        try:
            return read_toml(base / name)
        except ConfigError as error:
            raise ValueError(str(error)) from error

    return include


class RunConfig(Table):
    """Everything a run needs."""

    loop: LoopTable = LoopTable()
    realtime: RealtimeTable = RealtimeTable()
    guardian: GuardianTable = GuardianTable()
    bus: BusTable = BusTable()
    drive: DriveTable
    motor: Annotated[MotorTable, BeforeValidator(included)]
    controller: ControllerTable = Field(default_factory=cascade)
    """The control law; kind cascade may be left out."""
    observer: ObserverTable
    limits: LimitsTable
    feedback: FeedbackTable = FeedbackTable()
    reference: ReferenceTable
    """The speed reference w*."""
    stop: StopTable = StopTable()
    setpoint: SetpointTable = SetpointTable()
    log: LogTable = LogTable()
    criteria: CriteriaTable = CriteriaTable()
    emulator: EmulatorTable | None = None
    canopen: CanopenTable | None = None
    """The CANopen drive that hil configure sets up; left out: none."""
    faults: FaultsTable = FaultsTable()

    @model_validator(mode="after")
    def _shaft_in_its_model(self) -> RunConfig:
        if self.motor.shaft is not None and self.controller.kind == "fac":
            raise ValueError(
                "motor.shaft: the law fac commands the load itself, without a shaft in its model; remove it, "
                "or take another controller.kind"
            )
        return self

    @model_validator(mode="after")
    def _angle_within_limits(self) -> RunConfig:
        if self.follows_angle and self.limits.following_error_rad is None and not self.loop.shadow:
            raise ValueError(
                "limits.following_error_rad: missing; the law position pulls the harder the further the "
                "angle is off: say by how much it may be [rad]"
            )
        return self

    @model_validator(mode="after")
    def _feedback_in_time(self) -> RunConfig:
        if problem := self._seldom():
            raise ValueError(problem)
        return self

    def _seldom(self) -> str:
        """Why measurements may not be as seldom as feedback.period_ms says; empty when they may."""
        given, every, tick_ms = self.feedback.period_ms, self.feedback_every, self.loop.period_ns * 1e-6
        if given is None or (every == 1 and abs(given - tick_ms) < 1e-6 * tick_ms):
            return ""
        said = f"feedback.period_ms = {given:g}"
        if abs(given - every * tick_ms) > 1e-6 * tick_ms or not every:
            return f"{said} is no whole multiple of the loop's period, {tick_ms:g} ms; change loop.rate_hz"
        if every > self.loop.max_gap_ticks:
            return (
                f"{said} is {every} ticks, longer than loop.max_gap_ticks = {self.loop.max_gap_ticks}; raise "
                "that (64 at most), lower loop.rate_hz or let the drive send more often"
            )
        if given >= 250.0 * self.feedback.enable_timeout_s:
            return (
                f"{said}: within feedback.enable_timeout_s = {self.feedback.enable_timeout_s:g} come fewer "
                "than four measurements; raise it or let the drive send more often"
            )
        return self._needs_each_tick(said)

    def _needs_each_tick(self, said: str) -> str:
        """What of this configuration rests on a measurement in each tick; empty for nothing."""
        if self.drive.takes == "voltage":
            return (
                f"{said}: the drive takes voltages, and the current loop is closed over its measurements; "
                "lower loop.rate_hz to that"
            )
        if self.bus.sync == "kernel":
            return f'{said}: with bus.sync = "kernel" each SYNC is answered; take "loop"'
        known = self.drive.speed_filter.kind != "none" and self.drive.speed_filter.modelled
        if self.loop.pacing == "timer" and (known or self.motor.shaft is not None):
            return (
                f'{said}: with loop.pacing = "timer" the measurements slip from tick to tick, and the states '
                'of drive.speed_filter and motor.shaft are not to be known; take "feedback"'
            )
        return ""

    @property
    def feedback_every(self) -> int:
        """Ticks from one measurement of the drive to the next."""
        given = self.feedback.period_ms
        return 1 if given is None else round(given * 1e6 / self.loop.period_ns)

    @property
    def k_t(self) -> float:
        """Torque constant of the motor that is believed in [N m/A]."""
        return 1.5 * self.motor.n_p * self.motor.psi_f_wb

    @property
    def drive_k_t(self) -> float:
        """The torque constant that the drive reckons with [N m/A]."""
        return self.drive.torque_constant_n_m_a or self.k_t

    @property
    def map_facts(self) -> dict[str, Any]:
        """What a drive's map needs of the other tables: :func:`drivers.mapping.completed`."""
        rated = self.drive.rated_current_arms
        return {
            "lockstep": self.loop.clock == "lockstep",
            "pole_pairs": self.motor.n_p,
            "k_t": self.drive_k_t,
            "rated_torque": self.drive.rated_torque_n_m,
            "rated_current": None if rated is None else math.sqrt(2.0) * rated,
        }

    @property
    def commands_load(self) -> bool:
        """Whether its drive takes the load machine's torque, too: fac of a drive that takes voltages."""
        return self.controller.kind == "fac" and self.drive.takes == "voltage"

    @property
    def paired(self) -> bool:
        """Whether its law is half of one over two nodes: fac of a drive with its own current loop."""
        return self.controller.kind == "follow" or (
            self.controller.kind == "fac" and self.drive.takes != "voltage"
        )

    @property
    def follows_speed(self) -> bool:
        """False for a commanded torque: its speed reference means nothing."""
        return self.controller.kind not in COMMANDED

    @property
    def follows_angle(self) -> bool:
        """Whether its law closes the loop on the angle."""
        return bool(self.controller.kind == "position")

    @property
    def command(self) -> Command:
        """What the drive takes, with the limits of it."""
        limits, keys = self.limits, COMMAND_KEYS[self.drive.takes]
        step = getattr(limits, keys[1])
        if self.drive.takes == "voltage":
            return Command("voltage", "V", limits.u_max_v or 0.0, step, keys)
        if self.drive.takes == "current":
            return Command("current", "A", limits.i_max_a, step, keys)
        most = min(limits.torque_max_n_m or math.inf, self.drive_k_t * limits.i_max_a)
        return Command("torque", "N m", most, step, keys)


COMMANDED: Final = ("torque", "follow")
"""Laws that are commanded a torque and follow no speed."""
COMMAND_KEYS: Final[dict[Takes, tuple[str, str]]] = {
    "voltage": ("u_max_v", "du_max_v"),
    "current": ("i_max_a", "di_max_a"),
    "torque": ("torque_max_n_m", "dtorque_max_n_m"),
}
"""Keys of [limits] for the largest command and its largest change in a tick."""
_ONLY: Final = {
    "voltage": ("u_max_v", "du_max_v", "applied_deviation_max_v"),
    "current": ("di_max_a",),
    "torque": ("torque_max_n_m", "dtorque_max_n_m"),
}


def _of_the_drive(data: Mapping[str, Any]) -> list[str]:
    """What is missing or means nothing for a drive that takes what this one does."""
    drive, limits, observer = (data.get(name) for name in ("drive", "limits", "observer"))
    takes = takes_of(drive.get("signals") if isinstance(drive, Mapping) else None)
    problems: list[str] = []
    if isinstance(limits, Mapping):
        needed = COMMAND_KEYS[takes] if takes == "voltage" else COMMAND_KEYS[takes][1:]
        problems += [f"limits.{key}: missing; add it" for key in needed if limits.get(key) is None]
        problems += [
            f"limits.{key}: the drive takes {_TAKEN[takes]}, no {other}; remove it"
            for other, keys in _ONLY.items()
            for key in keys
            if other != takes and limits.get(key) is not None
        ]
    given = drive.get("speed_filter") if isinstance(drive, Mapping) else None
    if takes == "voltage" and isinstance(given, Mapping) and given.get("kind") != "none":
        problems.append(
            "drive.speed_filter: the drive takes voltages, and no law for those has the filter in its model; "
            "remove it, or switch the filter off in the drive"
        )
    if isinstance(observer, Mapping) and takes == "voltage" and observer.get("current") is None:
        problems.append("observer.current: missing; add it")
    return problems


_TAKEN: Final = {"voltage": "voltages", "current": "a current", "torque": "a torque"}


def load_toml(path: Path, model: type[Model], overrides: Iterable[str] = ()) -> Model:
    """Load and validate ``path`` as ``model``; ``overrides`` are ``table.key=value`` in TOML syntax.

    Raises :class:`hil.errors.ConfigError` that names every mistake, with a suggestion for unknown keys.
    """
    data = read_toml(path)
    for text in overrides:
        override(data, text, path.parent)
    if model is RunConfig:
        data = chosen(data, str(path))
    return validate(data, model, str(path), path.parent)


def validate(data: Mapping[str, Any], model: type[Model], where: str, base: Path | None) -> Model:
    """Validate ``data`` as ``model``; paths in it are relative to ``base``, and refused without one."""
    more = _of_the_drive(data) if model is RunConfig else []
    try:
        made = model.model_validate(data, context={"include": _includer(base)})
    except ValidationError as error:
        problems = [describe(problem, model) for problem in error.errors()]
        raise ConfigError(where, [*problems, *more]) from None
    if more:
        raise ConfigError(where, more)
    return made
