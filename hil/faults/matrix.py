"""The fault matrix as a file: for each row what goes wrong and what must come of it.

What is expected stands in the file and is never computed from a result. Faults of the drive and its bus are
tables of the emulated drive and are checked with its configuration; faults of the host are tables of this
module.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from hil.config.table import Finite, Positive, Table
from hil.config.tables import RunConfig, load_toml, validate
from hil.config.toml import read_toml
from hil.errors import ConfigError
from hil.signals import Reason

REASONS = frozenset(reason.name.lower() for reason in Reason if reason)


class Stall(Table):
    """The controller is stopped (SIGSTOP) and goes on after ``for_ms``."""

    kind: Literal["stall"]
    at_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
    """When [s from the start of the run]."""
    for_ms: Annotated[int, Field(ge=1, le=5000)]
    """How long the process stands still."""


class WriterKilled(Table):
    """The log's writer process is killed (SIGKILL)."""

    kind: Literal["writer-killed"]
    at_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
    """When [s from the start of the run]."""


class DiskFull(Table):
    """The log can't grow any more: the writer's file size limit is set to what it has."""

    kind: Literal["disk-full"]
    at_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
    """When [s from the start of the run]."""


class ClockStep(Table):
    """The wall clock that the controller's process reads jumps by ``step_s``."""

    kind: Literal["clock-step"]
    at_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
    """When [s from the start of the run]."""
    step_s: Finite
    """By how much the wall clock jumps."""


class InterfaceDown(Table):
    """The interface goes down (in a network namespace of the row's own), for good or for ``for_ms``."""

    kind: Literal["interface-down"]
    at_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
    """When [s from the start of the run]."""
    for_ms: Annotated[int, Field(ge=1, le=5000)] | None = None
    """For how long; left out: for good."""


Host = Annotated[Stall | WriterKilled | DiskFull | ClockStep | InterfaceDown, Field(discriminator="kind")]


class Expect(Table):
    """What must come of a fault. ``reason``: any of these ends the run; ``within_ms``: to the safe state.

    ``w_error_rad_s``: a run that rides through ends with the speed this near to its reference;
    ``w_max_rad_s`` and ``i_max_a``: the true speed and current from the fault on stay below.
    """

    reaction: Literal["ride through", "stop"]
    """The run rides through, or stops."""
    reason: list[str] = Field(default_factory=list)
    """Names of the reasons any of which may end the run (docs/stop-reasons.md)."""
    within_ms: Positive | None = None
    """Longest time from the fault to the safe state."""
    w_error_rad_s: Positive = 1.0
    """Largest |w* - w| at the end of a run that rides through."""
    w_max_rad_s: Positive | None = None
    """Largest true speed from the fault on; left out: not judged."""
    i_max_a: Positive | None = None
    """Largest true current from the fault on; left out: not judged."""
    log: Literal["complete", "readable"] = "complete"
    """The log is whole, or can at least be read."""
    node: str | None = None
    """Of several nodes the one that stops for this reason; every other one stops with it as node_stopped."""

    @field_validator("reason")
    @classmethod
    def _known(cls, value: list[str]) -> list[str]:
        unknown = [name for name in value if name not in REASONS]
        if unknown:
            raise ValueError(
                f"{', '.join(unknown)}: no reason of a stop; there are {', '.join(sorted(REASONS))}"
            )
        return value

    @model_validator(mode="after")
    def _complete(self) -> Expect:
        if self.reaction == "stop" and not (self.reason and self.within_ms):
            raise ValueError("a stop needs reason and within_ms")
        if self.reaction == "ride through" and (self.reason or self.within_ms):
            raise ValueError("a ride through has no reason and no within_ms")
        return self

    @property
    def text(self) -> str:
        """As the table shows it."""
        if self.reaction == "ride through":
            return self.reaction
        of = f"{self.node} " if self.node else ""
        return f"stop: {of}{' or '.join(self.reason)} within {self.within_ms:g} ms"

    def of(self, node: str) -> Expect:
        """What must come of it at one of several nodes."""
        other = self.reaction == "stop" and node != self.node
        return self.model_copy(update={"reason": ["node_stopped"]}) if other else self


class Row(Table):
    """One run with its faults; ``set`` and ``plant_set`` override keys of its configurations."""

    name: Annotated[str, Field(min_length=1, max_length=60)]
    """Name of the row, one of its own."""
    fault: list[dict[str, Any]] = Field(default_factory=list)
    """Faults of the drive and its bus, as in a plant's file (keys: plant:fault)."""
    host: Host | None = None
    """Fault of the host; left out: none."""
    set: list[str] = Field(default_factory=list)
    """Keys of the run's configuration for this row, as --set."""
    plant_set: list[str] = Field(default_factory=list)
    """Keys of the plant for this row, as --plant-set."""
    expect: Expect
    """What must come of it."""

    @property
    def realtime(self) -> bool:
        """Faults of the host need real time; all others run in lockstep."""
        return self.host is not None

    @property
    def onset_s(self) -> float:
        """When the last fault of the drive begins; those before it are its set-up."""
        return max((float(fault.get("at_s", 0.0)) for fault in self.fault), default=0.0)

    def plant_settings(self) -> list[str]:
        """Overrides of the plant for this row."""
        return [*self.plant_set, "black_box=true", f"fault={inline(self.fault)}"]


class Matrix(Table):
    """All rows, and what they have in common."""

    run: str = "demo.toml"
    """Path of the run's configuration, relative to this file."""
    set: list[str] = Field(default_factory=list)
    """Keys of the run's configuration for all rows, as --set."""
    host_set: list[str] = Field(default_factory=list)
    """The same for rows with a fault of the host alone."""
    host_plant_set: list[str] = Field(default_factory=list)
    """Keys of the plant for rows with a fault of the host."""
    plant_set: list[str] = Field(default_factory=list)
    """Keys of the plant for all rows, as --plant-set."""
    row: Annotated[list[Row], Field(min_length=1)]
    """The runs."""

    @model_validator(mode="after")
    def _names_differ(self) -> Matrix:
        names = [row.name for row in self.row]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"rows of the same name: {', '.join(twice)}")
        return self

    def settings(self, row: Row) -> tuple[str, ...]:
        """Overrides of the run configuration for a row."""
        host = self.host_set if row.realtime else ['loop.clock="lockstep"']
        return (*self.set, *host, *row.set)

    def plant_settings(self, row: Row) -> list[str]:
        """Overrides of the plant for a row."""
        host = self.host_plant_set if row.realtime else []
        return [*self.plant_set, *host, *row.plant_settings()]


def inline(value: Any) -> str:
    """A value in TOML's inline syntax."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {inline(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(inline, value)) + "]"
    if isinstance(value, (bool, str)):
        return json.dumps(value)
    return repr(value)


def load_matrix(path: Path, shipped: Path) -> tuple[Matrix, Path]:
    """The matrix that ``path`` names and its run configuration.

    ``path`` may be a matrix, or a run configuration that the shipped matrix is then run with, judged by what
    the configuration's own table ``[faults.expect]`` says of its rows.
    """
    data = read_toml(path)
    if "row" in data:
        matrix = load_toml(path, Matrix)
        return matrix, path.parent / matrix.run
    given = load_toml(path, RunConfig).faults.expect
    return _expecting(load_toml(shipped, Matrix), given, path), path


def _expecting(matrix: Matrix, given: dict[str, dict[str, Any]], path: Path) -> Matrix:
    """The matrix with other expectations of some rows. Raises ConfigError with all mistakes."""
    rows = {row.name: row for row in matrix.row}
    problems = [f"faults.expect: there is no row {name!r}" for name in given if name not in rows]
    for name, table in given.items():
        try:
            rows[name] = rows[name].model_copy(update={"expect": validate(table, Expect, name, path.parent)})
        except ConfigError as error:
            problems += [f"faults.expect: {name}: {problem}" for problem in error.problems]
        except KeyError:
            continue
    if problems:
        raise ConfigError(str(path), problems)
    return matrix.model_copy(update={"row": list(rows.values())})


def chosen(matrix: Matrix, names: list[str]) -> list[Row]:
    """The rows whose names contain one of ``names``; all without any. Raises ConfigError for none."""
    rows = [row for row in matrix.row if not names or any(name in row.name for name in names)]
    if not rows:
        known = ", ".join(row.name for row in matrix.row)
        raise ConfigError("--only", [f"{', '.join(names)}: no such row; there are {known}"])
    return rows
