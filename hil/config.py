"""Run configuration: typed, frozen, refuses unknown keys, names every mistake at once.

Units stand in the key names (``rate_hz``, ``i_max_a``). Paths are relative to the file they stand in.
What the values mean physically is left to the modules that use them.
"""

from __future__ import annotations

import difflib
import re
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)

from hil.control.registry import REQUIRED, Key, laws, observers
from hil.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)
MAX_CONFIG_BYTES = 1 << 20
# tomllib keeps every prefix of a dotted key: one of 100,000 parts would take 40 GB
_DEEP_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){16}""")

LEAST, MOST = 1e-12, 1e9
Positive = Annotated[float, Field(ge=LEAST, le=MOST, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=MOST, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
"""Ranges of physical quantities: no product or square of a few of them overflows or vanishes."""
Seconds = Annotated[float, Field(ge=1e-6, le=1e7, allow_inf_nan=False)]
"""Times whose nanoseconds and ticks are whole numbers with room to spare; 1e7 s are four months."""
Since = Annotated[float, Field(ge=0, le=1e7, allow_inf_nan=False)]
Speed = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
MOST_GUARDIAN_MS = 10_000
"""A guardian that waits longer is none."""


class Table(BaseModel):
    """Base of all tables: frozen, unknown keys refused, no silent conversion of strings."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of at most 1 MiB. Raises ConfigError with the file's name and the line."""
    try:
        with path.open("rb") as stream:  # a device has no size, and no end
            raw = stream.read(MAX_CONFIG_BYTES + 1)
        if len(raw) > MAX_CONFIG_BYTES:
            raise ConfigError(str(path), [f"larger than {MAX_CONFIG_BYTES} bytes; this is no configuration"])
        text = raw.decode()
    except OSError as error:
        raise ConfigError(str(path), [f"can't be read: {error.strerror or error}"]) from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), [f"is not TOML: {error}"]) from error
    if _DEEP_KEY.search(text):
        raise ConfigError(str(path), ["holds a key of more than 16 parts; this is no configuration"])
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # not TOML, or a number of too many digits
        raise ConfigError(str(path), [f"is not TOML: {error}"]) from error


def included(value: Any, info: ValidationInfo) -> Any:
    """A table may be given inline or as the path of a TOML file that holds it."""
    return info.context["include"](value) if isinstance(value, str) and info.context else value


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


class MotorTable(Table):
    """Parameters of a PMSM: what the controller believes. Amplitude-invariant dq, mechanical speed."""

    name: str = ""
    R_s_ohm: Positive
    L_d_h: Positive
    L_q_h: Positive
    psi_f_wb: Positive
    n_p: Annotated[int, Field(ge=1, le=100)]
    J_kg_m2: Positive
    B_f_n_m_s: NonNegative = 0.0


class LoopTable(Table):
    """Rate, pacing and clock of the loop."""

    rate_hz: Annotated[int, Field(ge=10, le=20_000)] = 1000
    pacing: Literal["sync", "feedback", "timer"] = "sync"
    clock: Literal["realtime", "lockstep"] = "realtime"
    duration_s: Seconds | None = None
    feedback_timeout_us: Annotated[int, Field(ge=10, le=100_000)] | None = None
    max_gap_ticks: Annotated[int, Field(ge=1, le=64)] = 20
    shadow: bool = False

    @field_validator("rate_hz")
    @classmethod
    def _whole_nanoseconds(cls, value: int) -> int:
        if 1_000_000_000 % value:
            raise ValueError(f"{value} Hz has no whole number of nanoseconds; take one that divides 1e9")
        return value

    @model_validator(mode="after")
    def _shorter_than_the_gap(self) -> LoopTable:
        given, most = self.feedback_timeout_us, self.max_gap_ticks * self.period_ns // 1000
        if given is not None and given > most:
            raise ValueError(
                f"feedback_timeout_us = {given} is longer than max_gap_ticks periods, {most} us: one tick "
                "without feedback would end the run; take less, 0.6 of the period is the default"
            )
        return self

    @property
    def period_ns(self) -> int:
        """T_s in nanoseconds."""
        return 1_000_000_000 // self.rate_hz

    @property
    def timeout_ns(self) -> int:
        """How long after its deadline a tick waits for feedback (default 0.6 T_s)."""
        return self.feedback_timeout_us * 1000 if self.feedback_timeout_us else self.period_ns * 6 // 10


class RealtimeTable(Table):
    """What is asked of the operating system; what it does not grant is said, not assumed."""

    fifo_priority: Annotated[int, Field(ge=0, le=98)] = 50
    cpu: Annotated[int, Field(ge=0, le=4095)] | None = None
    lock_memory: bool = True


class GuardianTable(Table):
    """The process that stops the drive when the loop falls silent for longer than any tolerated skip."""

    enabled: bool = True
    timeout_ms: Annotated[float, Field(ge=1, le=MOST_GUARDIAN_MS, allow_inf_nan=False)] | None = None

    def timeout_ns(self, loop: LoopTable) -> int:
        """Default: five periods more than the gap at which the supervisor stops, at least 10 ms."""
        if self.timeout_ms is not None:
            return round(self.timeout_ms * 1e6)
        return max((loop.max_gap_ticks + 5) * loop.period_ns, 10_000_000)


class BusTable(Table):
    """The CAN bus, in python-can's terms."""

    interface: str = "hil-local"
    channel: str = "demo"
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    data_bitrate: Annotated[int, Field(ge=10_000, le=8_000_000)] | None = None
    fd: bool = False


class DriveTable(Table):
    """The drive: its DBC and node."""

    dbc: str
    node_id: Annotated[int, Field(ge=0, le=255)] = 1
    node_rule: str = ""
    """Where the node's number goes in identifiers, as "id << 5"; empty: CANopen's."""
    heartbeat_timeout_s: Annotated[float, Field(ge=1e-3, le=3600, allow_inf_nan=False)] = 3.0
    signals: dict[str, Any] | None = None
    """Which signal of the DBC plays which part (drivers.mapping.DriveMap); None: the house protocol."""


def _annotation(key: Key) -> tuple[Any, Any]:
    """Type and default of a member's key, as pydantic takes them."""
    if key.type == "flag":
        return bool, key.default
    most = MOST if key.most is None else key.most
    least = LEAST if key.least is None and key.above == 0.0 else key.least
    bounds: Any = Field(gt=key.above, ge=least, le=most, allow_inf_nan=False)
    kind: Any = Annotated[float, bounds]
    if key.type == "numbers":
        kind = Annotated[list[kind], Field(min_length=1, max_length=key.count)]
    return (
        (kind, ...)
        if key.default is REQUIRED
        else (kind | None if key.default is None else kind, key.default)
    )


def _tables(members: Mapping[str, Any], suffix: str, common: dict[str, Any]) -> Any:
    """The union of the tables of all members; ``kind`` tells them apart, the most usual may leave it out."""
    made = []
    for kind, member in members.items():
        fields = {name: _annotation(key) for name, key in member.keys.items()} | common
        name = "".join(part.title() for part in kind.split("-")) + suffix
        tag: Any = (Literal[kind], kind)
        table = create_model(name, __base__=Table, __doc__=member.doc, kind=tag, **fields)
        made.append(Annotated[table, Tag(kind)])
    names = ", ".join(repr(kind) for kind in members)
    return Annotated[
        Union[tuple(made)],  # noqa: UP007 - made at run time
        Discriminator(
            _observer_kind if suffix == "Observer" else _law_kind,
            custom_error_type="unknown_kind",
            custom_error_message=f"kind must be one of {names}",
        ),
    ]


def _observer_kind(value: Any) -> Any:
    """The kind that an observer's table names; the paper's when it names none."""
    return value.get("kind", "ftdob") if isinstance(value, Mapping) else getattr(value, "kind", None)


def _law_kind(value: Any) -> Any:
    """The kind that a law's table names; the cascade when it names none."""
    return value.get("kind", "cascade") if isinstance(value, Mapping) else getattr(value, "kind", None)


if typing.TYPE_CHECKING:
    ChannelTable = Any
    ControllerTable = Any
else:
    ChannelTable = _tables(observers(), "Observer", {})
    """One channel's observer: a table of each registered kind (:mod:`hil.control.observers`)."""
    ControllerTable = _tables(laws(), "Controller", {"compensate_coupling": (bool, True)})
    """The control law: a table of each registered kind (:mod:`hil.control.laws`)."""


class ObserverTable(Table):
    """The disturbance observer of the speed channel and of both current channels."""

    speed: ChannelTable
    current: ChannelTable


class LimitsTable(Table):
    """What must never be exceeded. There are no defaults for the first five: a user decides them."""

    w_max_rad_s: Positive
    i_max_a: Positive
    i_trip_a: Positive
    u_max_v: Positive
    du_max_v: Positive
    T_L_max_n_m: NonNegative = 0.0
    v_dc_min_v: NonNegative = 0.0
    v_dc_max_v: Positive = 1e4
    temperature_max_c: Annotated[float, Field(ge=-273.15, le=1e4, allow_inf_nan=False)] = 120.0
    i_continuous_a: Positive | None = None
    i2t_max_a2s: Positive | None = None
    power_window_s: Annotated[float, Field(ge=1e-3, le=1e5, allow_inf_nan=False)] = 1.0
    energy_max_j: Positive | None = None
    applied_deviation_max_v: Positive | None = None
    following_error_rad_s: Positive | None = None
    following_error_s: Annotated[float, Field(ge=1e-6, le=3600, allow_inf_nan=False)] = 0.1
    i_d_max_a: Positive | None = None
    open_phase_min_a: Positive | None = None
    trip_ticks: Annotated[int, Field(ge=1, le=1000)] = 3
    guard_trip_ticks: Annotated[int, Field(ge=1, le=10**9)] = 200
    soft_start_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] = 0.0

    @model_validator(mode="after")
    def _ordered(self) -> LimitsTable:
        if self.i_trip_a <= self.i_max_a:
            raise ValueError("i_trip_a must be above i_max_a, or normal operation trips")
        if self.v_dc_max_v <= self.v_dc_min_v:
            raise ValueError("v_dc_max_v must be above v_dc_min_v")
        return self


class FeedbackTable(Table):
    """What to do when feedback is missing or damaged: hold, then quick stop, then fault."""

    hold_ticks: Annotated[int, Field(ge=0, le=1000)] = 3
    quick_stop_ticks: Annotated[int, Field(ge=1, le=10_000)] = 20
    error_budget: Annotated[int, Field(ge=1, le=10_000)] = 8
    frozen_ticks: Annotated[int, Field(ge=1, le=10_000)] = 5
    repeat_ticks: Annotated[int, Field(ge=2, le=10_000)] | None = None
    enable_timeout_s: Annotated[float, Field(ge=1e-3, le=3600, allow_inf_nan=False)] = 2.0
    status_timeout_s: Annotated[float, Field(ge=1e-3, le=3600, allow_inf_nan=False)] | None = None
    """Age that a slow message of the drive may reach; by default from its cycle time in the DBC."""


class StepReference(Table):
    """w* jumps from 0 to ``w_rad_s`` at ``at_s``."""

    kind: Literal["step"]
    w_rad_s: Speed
    at_s: Since = 0.0
    i_q_a: Finite = 0.0


class RampReference(Table):
    """w* ramps to ``w_rad_s`` with ``rate_rad_s2``, and back to 0 from ``down_at_s`` on."""

    kind: Literal["ramp"]
    w_rad_s: Speed
    rate_rad_s2: Positive
    at_s: Since = 0.0
    down_at_s: Since | None = None
    i_q_a: Finite = 0.0


class SCurveReference(Table):
    """Jerk-limited ramp to ``w_rad_s``, and back to 0 from ``down_at_s`` on."""

    kind: Literal["s-curve"]
    w_rad_s: Speed
    rate_rad_s2: Positive
    jerk_rad_s3: Positive
    at_s: Since = 0.0
    down_at_s: Since | None = None
    i_q_a: Finite = 0.0


class SineReference(Table):
    """w* = offset + amplitude sin(2 pi f t)."""

    kind: Literal["sine"]
    offset_rad_s: Speed = 0.0
    amplitude_rad_s: Speed
    frequency_hz: Positive
    i_q_a: Finite = 0.0


class TableReference(Table):
    """Piecewise linear through (t, w) points."""

    kind: Literal["table"]
    t_s: Annotated[list[Since], Field(min_length=2, max_length=256)]
    w_rad_s: Annotated[list[Speed], Field(min_length=2, max_length=256)]
    i_q_a: Finite = 0.0

    @model_validator(mode="after")
    def _matching(self) -> TableReference:
        if len(self.t_s) != len(self.w_rad_s):
            raise ValueError("t_s and w_rad_s must have the same length")
        if any(b <= a for a, b in zip(self.t_s, self.t_s[1:], strict=False)):
            raise ValueError("t_s must increase")
        return self


ReferenceTable = Annotated[
    StepReference | RampReference | SCurveReference | SineReference | TableReference,
    Field(discriminator="kind"),
]


class StopTable(Table):
    """How an orderly stop ends: the speed reference ramps to zero, then the drive is stopped.

    For the first Ctrl-C, SIGTERM, the stop button and the end of ``duration_s``; a second Ctrl-C, a
    dead-man's switch and every fault stop at once. ``ramp_rad_s2``: 0 stops at once; None takes w_max in a
    second, at most half of what the motor's torque gives. After ``ramp_max_s`` the drive is stopped anyway.
    """

    ramp_rad_s2: NonNegative | None = None
    ramp_max_s: Annotated[float, Field(gt=0, le=60)] = 5.0


class SetpointTable(Table):
    """What ``hil set`` may ask of a running run; None: 0.9 of the limit, at the rate of the stop's ramp."""

    enabled: bool = True
    w_min_rad_s: Finite | None = None
    w_max_rad_s: Finite | None = None
    rate_rad_s2: Positive | None = None
    i_q_max_a: Positive | None = None
    i_q_rate_a_s: Positive | None = None


class LogTable(Table):
    """Where the log goes."""

    folder: str = "../logs"
    name: str | None = None
    frames: bool = True
    compression: Literal["zstd", "lz4"] = "zstd"
    split_s: Annotated[float, Field(ge=1, le=1e7, allow_inf_nan=False)] | None = None
    split_mb: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)] | None = None


class CriteriaTable(Table):
    """What a run must reach, judged by ``hil report``; every one is the largest value that passes."""

    tracking_rms_max_rad_s: NonNegative | None = None
    dip_max_rad_s: NonNegative | None = None
    recovery_max_s: NonNegative | None = None
    rise_max_s: NonNegative | None = None
    overshoot_max_percent: NonNegative | None = None
    settling_max_s: NonNegative | None = None
    estimate_error_max_n_m: NonNegative | None = None
    ripple_max_rad_s: NonNegative | None = None
    iae_max_rad: NonNegative | None = None
    skipped_max: Annotated[int, Field(ge=0, le=10**15)] | None = None
    dropped_max: Annotated[int, Field(ge=0, le=10**15)] | None = None
    lost_feedback_max: Annotated[int, Field(ge=0, le=10**15)] | None = None
    crc_errors_max: Annotated[int, Field(ge=0, le=10**15)] | None = None
    lateness_p999_max_us: NonNegative | None = None
    lateness_max_us: NonNegative | None = None
    bus_load_max_percent: NonNegative | None = None


class EmulatorTable(Table):
    """The emulated drive that belongs to this run; its parameters are in its own file."""

    plant: str


def _cascade() -> Any:
    """The controller of a config that names none."""
    adapter: Any = TypeAdapter(ControllerTable)
    return adapter.validate_python({"kind": "cascade"})


class FaultsTable(Table):
    """What `hil faults` expects of this configuration: by row, in place of what the shipped matrix does."""

    expect: dict[str, dict[str, Any]] = Field(default_factory=dict)


class RunConfig(Table):
    """Everything a run needs."""

    loop: LoopTable = LoopTable()
    realtime: RealtimeTable = RealtimeTable()
    guardian: GuardianTable = GuardianTable()
    bus: BusTable = BusTable()
    drive: DriveTable
    motor: Annotated[MotorTable, BeforeValidator(included)]
    controller: ControllerTable = Field(default_factory=_cascade)
    observer: ObserverTable
    limits: LimitsTable
    feedback: FeedbackTable = FeedbackTable()
    reference: ReferenceTable
    stop: StopTable = StopTable()
    setpoint: SetpointTable = SetpointTable()
    log: LogTable = LogTable()
    criteria: CriteriaTable = CriteriaTable()
    emulator: EmulatorTable | None = None
    faults: FaultsTable = FaultsTable()


def load_toml(path: Path, model: type[Model], overrides: Iterable[str] = ()) -> Model:
    """Load and validate ``path`` as ``model``; ``overrides`` are ``table.key=value`` in TOML syntax.

    Raises :class:`hil.errors.ConfigError` that names every mistake, with a suggestion for unknown keys.
    """
    data = read_toml(path)
    for text in overrides:
        override(data, text, path.parent)
    return validate(data, model, str(path), path.parent)


def validate(data: Mapping[str, Any], model: type[Model], where: str, base: Path | None) -> Model:
    """Validate ``data`` as ``model``; paths in it are relative to ``base``, and refused without one."""
    try:
        return model.model_validate(data, context={"include": _includer(base)})
    except ValidationError as error:
        problems = [_describe(problem, model) for problem in error.errors()]
        raise ConfigError(where, problems) from None


def override(data: dict[str, Any], setting: str, base: Path) -> None:
    """Set one ``table.key=value``; a value that is not TOML is taken as a string.

    A table that is given as the path of a file is read first, so that one key of it can be changed.
    """
    key, equals, text = setting.partition("=")
    if not equals or not key.strip():
        raise ConfigError("--set", [f"{setting!r} is not of the form table.key=value"])
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    put(data, key.strip(), value, base)


def put(data: dict[str, Any], key: str, value: Any, base: Path, where: str = "--set") -> None:
    """Set the key ``table.key``, of an array of tables ``table.0.key``, to ``value``. Raises ConfigError.

    A table that is given as the path of a file, relative to ``base``, is read first.
    """
    *tables, last = key.split(".")
    place: Any = data
    for name in tables:
        place = _table_of(place, name, base)
        if not isinstance(place, dict | list):
            raise ConfigError(where, [f"{key}: {name} is not a table"])
    if isinstance(place, dict):
        place[last] = value
        return
    place[_row(place, last, key, where)] = value


def _table_of(place: Any, name: str, base: Path) -> Any:
    """What ``name`` leads to, a new table where there is none; None where it leads nowhere."""
    if isinstance(place, list):
        return place[int(name)] if name.isdecimal() and int(name) < len(place) else None
    if isinstance(place.get(name), str) and place[name].endswith(".toml"):
        place[name] = read_toml(base / place[name])
    return place.setdefault(name, {})


def _row(rows: list[Any], name: str, key: str, where: str) -> int:
    if not name.isdecimal() or int(name) >= len(rows):
        raise ConfigError(where, [f"{key}: there are entries 0 to {len(rows) - 1}, and no {name}"])
    return int(name)


def _describe(problem: Any, model: type[BaseModel]) -> str:
    """One line for one pydantic problem: key path, what is wrong, what to do."""
    path = ".".join(_written(problem["loc"]))
    if problem["type"] == "extra_forbidden":
        near = difflib.get_close_matches(str(problem["loc"][-1]), _keys_at(model, problem["loc"][:-1]), n=1)
        return f"{path}: unknown key" + (f"; did you mean {near[0]!r}?" if near else "; remove it")
    if problem["type"] == "missing":
        return f"{path}: missing; add it"
    text = problem["msg"].removeprefix("Value error, ")
    text = text[:1].lower() + text[1:]
    return f"{path}: {text}{_given(problem.get('input'))}"


def _given(value: Any) -> str:
    """What stood there, when it is no table; a number of hundreds of digits in short."""
    if not isinstance(value, (int, float, str)):
        return ""
    text = (
        repr(value) if not isinstance(value, int) or value.bit_length() < 256 else "a number beyond any range"
    )
    return f", not {text if len(text) <= 80 else text[:77] + '...'}"


def _written(loc: tuple[Any, ...]) -> list[str]:
    """The key path as the file has it: pydantic names the kind of a law or an observer after its table."""
    kinds: dict[Any, Any] = {"controller": laws(), "speed": observers(), "current": observers()}
    before = ("", *loc)[: len(loc)]
    return [str(part) for table, part in zip(before, loc, strict=True) if part not in kinds.get(table, ())]


def _keys_at(model: type[BaseModel], loc: tuple[Any, ...]) -> list[str]:
    """Keys of the table at ``loc``; for a union of tables, of all its members that the tag names."""
    models: list[type[BaseModel]] = [model]
    for part in loc:
        found = [
            m
            for owner in models
            if part in owner.model_fields
            for m in _models_in(owner.model_fields[part].annotation)
        ]
        models = found or [m for m in models if part in _tags(m)] or models
    return [key for m in models for key in m.model_fields]


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is not None:
        return [m for a in typing.get_args(annotation) for m in _models_in(a)]
    return []


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    kind = model.model_fields.get("kind")
    return typing.get_args(kind.annotation) if kind else ()
