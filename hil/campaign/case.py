"""One case from its number to its row: the run configuration and its plant read once, the rest a case's own.

A case that cannot be loaded, or that breaks, is a row with the reason. What a case gives depends on the job
and its number alone: every cache here is of a pure function.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Final

from drivers.codec import Database
from drivers.errors import DriverError
from firmware_model.config import PlantConfig, Wire
from firmware_model.node import wire_of
from hil.campaign.figures import KEYS, Judged
from hil.campaign.margins import design_margins
from hil.campaign.onbus import judged_on_the_bus
from hil.campaign.plan import PLANT, Builder, Plan, PlanTable, Settings
from hil.campaign.values import toml
from hil.config.tables import RunConfig, validate
from hil.config.toml import override, put, read_toml
from hil.control.errors import ControlDesignError
from hil.control.law import exact_after
from hil.errors import ConfigError, HilError
from hil.report.criteria import demanded
from hil.runtime.setup import Setup, setup_of
from hil.signals import Reason
from hil.sim.columns import Columns
from hil.sim.simulate import Simulation, simulation_of
from hil.tick.reasons import explain

REFUSALS: Final = (HilError, DriverError, ControlDesignError)
SETUPS: Final = 64
WORDS: Final = ("case", "sample", "variant", "seed", "ended", "passed", "why")


def first_line(error: Exception) -> str:
    """What an error says, in a line."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


class Stand:
    """Everything that the cases of a plan share. ``path``: the run configuration in its folder."""

    def __init__(self, path: Path, table: PlanTable, where: str) -> None:
        self.path = path
        self._config = _opened(read_toml(path), path.parent)
        for text in table.settings:
            override(self._config, text, path.parent)
        self._config_set, self._plant_set = table.settings, table.plant_set
        self._plants = lru_cache(maxsize=16)(self._read_plant)
        self._databases = lru_cache(maxsize=16)(Database)
        self._wires = lru_cache(maxsize=16)(lambda dbc, node, kind: wire_of(self._databases(dbc, node), kind))
        self._setups: dict[str, Setup] = {}
        self._rooms: list[Columns] = []  # as many as threads were in run at once
        self.plan: Plan = Builder(where, self.own).build(table)
        for key, value in self.plan.fixed.items():
            put(self._config, key, value, path.parent)

    def _read_plant(self, name: str) -> dict[str, Any]:
        path = self.path.parent / name
        data = _opened(read_toml(path), path.parent)
        for text in self._plant_set:
            override(data, text, path.parent)
        return data

    def own(self, key: str) -> Any:
        """A key's value in the configuration or the plant; None where it has none."""
        data, name = self._config, key
        if key.startswith(PLANT):
            data, name = self._plants(self._plant_of(self._config)), key[len(PLANT) :]
        place: Any = data
        for part in name.split("."):
            if isinstance(place, list):
                place = place[int(part)] if part.isdecimal() and int(part) < len(place) else None
            else:
                place = place.get(part) if isinstance(place, dict) else None
        return place

    def _plant_of(self, data: dict[str, Any]) -> str:
        name = data.get("emulator", {}).get("plant") if isinstance(data.get("emulator"), dict) else None
        if not isinstance(name, str):
            raise ConfigError(
                str(self.path), ['emulator: missing; add [emulator] with plant = "plants/demo.toml"']
            )
        return name

    @cached_property
    def limits(self) -> dict[str, float]:
        """What [criteria] demands: figure key to largest value."""
        return demanded(self._setup({}).config.criteria)

    def columns(self) -> list[str]:
        """The names of a row's columns, in order."""
        figures = [*KEYS, *(f"criteria:{key}" for key in self.limits)]
        return [*WORDS[:4], *self.plan.keys, *WORDS[4:], *figures]

    def _setup(self, settings: Settings) -> Setup:
        """The designed controller of some settings of the configuration."""
        key = repr(settings)  # tells 1 from 1.0 and True, which are equal
        if key not in self._setups:
            data = with_settings(self._config, settings, self.path.parent, "config")
            config = validate(data, RunConfig, "config", self.path.parent)
            made = setup_of(self.path, config, self._databases)
            if len(self._setups) >= SETUPS:
                self._setups.clear()
            self._setups[key] = made
        return self._setups[key]

    def _plant(self, setup: Setup, settings: Settings, seed: int | None) -> tuple[PlantConfig, Wire]:
        name = setup.config.emulator.plant if setup.config.emulator else self._plant_of({})
        folder = (self.path.parent / name).parent
        seeded = settings if seed is None else {"seed": seed} | settings
        data = with_settings(self._plants(name), seeded, folder, "plant")
        plant = validate(data, PlantConfig, "plant", folder)
        return plant, self._wires(folder / plant.dbc, plant.node_id, plant.protocol)

    def parts(self, settings: Settings, seed: int | None = None) -> tuple[Setup, PlantConfig, Wire]:
        """Controller and plant of some settings. Raises HilError, DriverError, ControlDesignError."""
        own = {key: value for key, value in settings.items() if not key.startswith(PLANT)}
        plant_settings = {
            key[len(PLANT) :]: value for key, value in settings.items() if key.startswith(PLANT)
        }
        setup = self._setup(own)
        return (setup, *self._plant(setup, plant_settings, seed))

    def simulation(self, settings: Settings, seed: int | None = None) -> tuple[Setup, Simulation]:
        """:meth:`parts`, ready to run. Raises what they do, and for a plant that needs the bus."""
        setup, plant, wire = self.parts(settings, seed)
        return setup, simulation_of(setup, plant, wire)

    def check(self, settings: Settings) -> None:
        """Raise what :meth:`run` would refuse the settings for."""
        setup, plant, wire = self.parts(settings)
        if not plant.fault:
            simulation_of(setup, plant, wire)

    def on_bus(self, case: int) -> bool:
        """True for a case with a fault script; what can't be is no such case."""
        try:
            return bool(self.parts(self.plan.settings(case))[1].fault)
        except REFUSALS:
            return False

    def texts(self, settings: Settings, seed: int | None) -> tuple[list[str], list[str]]:
        """What sets a case of the configuration and of the plant, as KEY=VALUE."""
        own, plant = list(self._config_set), list(self._plant_set)
        seeded = {} if seed is None else {f"{PLANT}seed": seed}
        for key, value in (self.plan.fixed | seeded | settings).items():
            place, name = (plant, key[len(PLANT) :]) if key.startswith(PLANT) else (own, key)
            place.append(f"{name}={toml(value)}")
        return own, plant

    @contextlib.contextmanager
    def _room(self) -> Iterator[Columns]:
        """Room that no other thread has meanwhile; fresh pages would take longer to come by."""
        room = self._rooms.pop() if self._rooms else Columns()
        yield room
        self._rooms.append(room)

    def _said(self, error: Exception) -> str:
        """The first line, with files as seen from the configuration: each worker has a folder of its own."""
        return first_line(error).replace(f"{self.path.parent}{os.sep}", "")

    def run(self, case: int) -> dict[str, Any]:
        """The row of a case, whatever becomes of it."""
        settings = self.plan.settings(case)
        seed = self.plan.noise_seed(case)
        row: dict[str, Any] = {
            "case": case,
            "sample": self.plan.split(case)[1],
            "variant": self.plan.variant(case),
            "seed": seed,
        }
        row |= settings
        try:
            setup, plant, wire = self.parts(settings, seed)
            with self._room() as room:
                if plant.fault:
                    return row | judged_on_the_bus(setup, *self.texts(settings, seed), room)
                return row | judged(setup, simulation_of(setup, plant, wire), room)
        except REFUSALS as error:
            return row | {"ended": "refused", "passed": False, "why": self._said(error)}
        except Exception as error:  # noqa: BLE001 - one case that breaks is a row, not the end of the campaign
            why = f"{type(error).__name__}: {self._said(error)}"
            return row | {"ended": "broke", "passed": False, "why": why}


def judged(setup: Setup, simulation: Simulation, room: Columns) -> dict[str, Any]:
    """Simulate; the figures, and why it ended where nobody asked."""
    found = Judged(setup.config, exact_after(setup.machine.law)[0])
    for ticks in simulation.columns(room):
        found.feed(ticks)
    stop = room.stop[0] if found.reason else None
    row, machine = found.finish() | design_margins(setup), simulation.machine
    end = None if stop is None else explain(machine.safety, machine.safety_state, stop)
    if end is None:
        return row | {"end": None}
    asked = found.reason == Reason.STOP_REQUESTED
    return row | {"end": end.as_dict(), "why": row["why"] if asked else end.text}


def with_settings(data: dict[str, Any], settings: Settings, base: Path, where: str) -> dict[str, Any]:
    """The data with settings, itself unchanged: only the tables on the way to a key are copied."""
    out = dict(data)
    for key, value in settings.items():
        place: Any = out
        for name in key.split(".")[:-1]:
            at: Any = int(name) if isinstance(place, list) and name.isdecimal() else name
            try:
                inner = place[at] = copy(place[at])
            except (LookupError, TypeError):  # not there: put makes it, or says why not
                break
            place = inner
        put(out, key, value, base, where)
    return out


def _opened(data: dict[str, Any], base: Path) -> dict[str, Any]:
    """The data with the tables that it names as files read, once instead of for every case."""
    return {
        name: read_toml(base / value) if isinstance(value, str) and value.endswith(".toml") else value
        for name, value in data.items()
    }


@dataclass(frozen=True)
class CaseJob:
    """A campaign as it goes to a worker: the plan and every file that its cases read."""

    config: str
    files: tuple[tuple[str, bytes], ...]
    table: str
    where: str

    @property
    def unit(self) -> str:
        """What is counted."""
        return "cases"

    def run(self, start: int, stop: int) -> list[dict[str, Any]]:
        """The rows of the cases from ``start`` up to ``stop``."""
        stand = stand_of(self)
        return [stand.run(case) for case in range(start, stop)]


@lru_cache(maxsize=2)
def stand_of(job: CaseJob) -> Stand:
    """The stand of a job, made once a process, from its files in a folder that goes with the process."""
    holder = tempfile.TemporaryDirectory(prefix="hil-campaign-")
    unpack(job.files, Path(holder.name))
    stand = Stand(Path(holder.name) / job.config, PlanTable.model_validate_json(job.table), job.where)
    _held.append(holder)
    return stand


_held: list[tempfile.TemporaryDirectory[str]] = []


def unpack(files: tuple[tuple[str, bytes], ...], folder: Path) -> None:
    """Write the files of a job under a folder."""
    for name, content in files:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def job_of(plan_path: Path, table: PlanTable) -> tuple[CaseJob, Stand]:
    """The job of a plan, and the stand of this process. Raises HilError."""
    path = (plan_path.parent / table.config).resolve()
    stand = Stand(path, table, str(plan_path))
    files = files_of(stand, path)
    root = Path(*_common([file.parts[:-1] for file in files]))
    packed = tuple((PurePosixPath(file.relative_to(root)).as_posix(), file.read_bytes()) for file in files)
    job = CaseJob(
        path.relative_to(root).as_posix(), packed, table.model_dump_json(by_alias=True), str(plan_path)
    )
    refuse_unknown(stand, str(plan_path))
    return job, stand


def _common(folders: list[tuple[str, ...]]) -> list[str]:
    """The parts of the folder that all are in."""
    out = []
    for parts in zip(*folders, strict=False):
        if len(set(parts)) > 1:
            break
        out.append(parts[0])
    return out


def files_of(stand: Stand, path: Path) -> list[Path]:
    """Every file that a case may read: configuration, plant, what they include, DBCs, files in values."""
    found = {path: None} | dict.fromkeys(_named(read_toml(path), path.parent))
    plant = path.parent / str(stand.own("emulator.plant"))
    found |= {plant.resolve(): None} | dict.fromkeys(_named(read_toml(plant), plant.parent))
    for key, values in stand.plan.listed().items():
        base = plant.parent if key.startswith(PLANT) else path.parent
        for file in _named(list(values), base):
            found |= {file: None}
            if file.suffix == ".toml":
                found |= dict.fromkeys(_named(read_toml(file), file.parent))
    return list(found)


def _named(value: Any, base: Path) -> list[Path]:
    """Files that texts anywhere in a value name, relative to a folder."""
    if isinstance(value, str):
        known = value.endswith((".toml", ".dbc")) and (base / value).is_file()
        return [(base / value).resolve()] if known else []
    if isinstance(value, Mapping):
        return [file for item in value.values() for file in _named(item, base)]
    if isinstance(value, list | tuple):
        return [file for item in value for file in _named(item, base)]
    return []


def refuse_unknown(stand: Stand, where: str) -> None:
    """Refuse a plan whose base, or a key of it, can't be set at all. Raises HilError."""
    stand.check({})
    problems, bases = [], [settings for _, settings in stand.plan.variants] or [{}]
    for key, values in stand.plan.listed().items():
        found = [_why_in_all(stand, bases, {key: value}) for value in values]
        unknown = [
            why for why in found if why is not None and ("unknown key" in why or "is not a table" in why)
        ]
        unknown += [why for why in found if why is not None and "there are entries" in why]
        if unknown and all(found):
            problems.append(_named_by(key, unknown[0].partition(": ")[2]))
    if problems:
        raise ConfigError(where, problems)
    firsts = [_why(stand, stand.plan.settings(case)) for case in range(min(stand.plan.count, 16))]
    if all(firsts):
        raise ConfigError(where, [f"none of its first {len(firsts)} cases can be: {firsts[0]}"])


def _named_by(key: str, text: str) -> str:
    """A problem that begins with the key as the plan has it."""
    plant, name = (PLANT, key[len(PLANT) :]) if key.startswith(PLANT) else ("", key)
    return f"{plant}{text}" if text.startswith(name) else f"{key}: {text}"


def _why_in_all(stand: Stand, bases: list[Settings], settings: Settings) -> str | None:
    """Why settings can't be in any variant; None when they can in one."""
    found = [_why(stand, base | settings) for base in bases]
    return None if None in found else found[0]


def _why(stand: Stand, settings: Settings) -> str | None:
    """Why settings can't be; None when they can."""
    try:
        stand.check(settings)
    except REFUSALS as error:
        return first_line(error)
    return None


__all__ = ["CaseJob", "Stand", "job_of", "stand_of"]
