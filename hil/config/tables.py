"""Run configuration: typed, frozen, refuses unknown keys, names every mistake at once.

Units stand in the key names (``rate_hz``, ``i_max_a``). Paths are relative to the file they stand in.
What the values mean physically is left to the modules that use them.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, Union

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

from hil.config.nodes import chosen
from hil.control.cogging import MOST_ORDER, ORDERS, Harmonics
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


class IdentifiedTable(Table):
    """What ``hil identify`` adds to a motor: from when and what, 95 % intervals by the motor's keys, noise.

    No run reads it; ``hil tune`` does.
    """

    date: str
    """When it was identified, UTC."""
    drive: str
    """On which drive and bus."""
    logs: list[str] = []
    """The runs that it was estimated from."""
    low: dict[str, Finite] = {}
    """Lower ends of the 95 % intervals, by the motor's keys."""
    high: dict[str, Finite] = {}
    """Upper ends of the 95 % intervals, by the motor's keys."""
    coulomb_n_m: NonNegative | None = None
    """Coulomb friction."""
    w_noise_rad_s: NonNegative | None = None
    """Noise of the measured speed, resolution included, standard deviation."""
    i_noise_a: NonNegative | None = None
    """Noise of the measured currents, resolution included, standard deviation."""
    delay_ticks: Annotated[int, Field(ge=0, le=100)] | None = None
    """Ticks from sending a voltage to its effect."""


class MotorTable(Table):
    """Parameters of a PMSM: what the controller believes. Amplitude-invariant dq, mechanical speed."""

    name: str = ""
    """What the motor is called, for reports."""
    R_s_ohm: Positive
    """Resistance R_s of a phase."""
    L_d_h: Positive
    """Inductance L_d of the d axis."""
    L_q_h: Positive
    """Inductance L_q of the q axis."""
    psi_f_wb: Positive
    """Flux linkage psi_f of the magnets: peak phase voltage over electrical speed."""
    n_p: Annotated[int, Field(ge=1, le=100)]
    """Pole pairs n_p."""
    J_kg_m2: Positive
    """Moment of inertia J of motor and load together."""
    B_f_n_m_s: NonNegative = 0.0
    """Viscous friction B_f: torque over mechanical speed."""
    identified: IdentifiedTable | None = None
    """Where the values come from, when hil identify found them."""


class AnticoggingTable(Table):
    """Load torque over the shaft's angle theta, as hil identify --steps cogging writes it:
    T_c = sum of cos_n_m cos(n theta) + sin_n_m sin(n theta) over the orders n."""

    date: str = ""
    """When it was learned, UTC."""
    drive: str = ""
    """On which drive and bus."""
    logs: list[str] = []
    """The runs that it was learned from."""
    motor: str = ""
    """Name of the motor that it is of."""
    n_p: Annotated[int, Field(ge=1, le=100)]
    """Pole pairs of the motor that it is of."""
    k_t_n_m_a: Positive
    """Torque constant of the motor that it is of, by which currents became torques."""
    speed_rad_s: Positive | None = None
    """Speed at which it was learned."""
    laps: Annotated[int, Field(ge=0, le=10**9)] = 0
    """Whole turns that it was learned from."""
    residual_n_m: NonNegative | None = None
    """What no harmonic explained, rms."""
    orders: Annotated[list[Annotated[int, Field(ge=1, le=MOST_ORDER)]], Field(max_length=ORDERS)] = []
    """Periods in a turn of the shaft, ascending."""
    cos_n_m: list[Finite] = []
    """Cosine coefficient of each order."""
    sin_n_m: list[Finite] = []
    """Sine coefficient of each order."""
    error_n_m: list[NonNegative] = []
    """Half of the 95 % interval of each order's coefficients."""

    @model_validator(mode="after")
    def _as_many(self) -> AnticoggingTable:
        n = len(self.orders)
        sizes = [len(row) for row in (self.cos_n_m, self.sin_n_m)]
        if n == 0:
            raise ValueError("orders: missing; learn it anew, or leave anticogging out")
        if sizes != [n, n] or len(self.error_n_m) not in (0, n):
            raise ValueError("orders, cos_n_m, sin_n_m and error_n_m must be of one length; learn it anew")
        if any(a >= b for a, b in zip(self.orders, self.orders[1:], strict=False)):
            raise ValueError("orders must ascend; learn it anew")
        return self

    @property
    def known(self) -> Harmonics:
        """As the law takes it."""
        return Harmonics(tuple(self.orders), tuple(self.cos_n_m), tuple(self.sin_n_m))


class LoopTable(Table):
    """Rate, pacing and clock of the loop."""

    rate_hz: Annotated[int, Field(ge=10, le=20_000)] = 1000
    """Ticks a second, 1 / T_s; divides 1e9, so that a period is a whole number of nanoseconds."""
    pacing: Literal["sync", "feedback", "timer"] = "sync"
    """What begins a tick: our SYNC, the drive's cyclic frame (feedback), or the loop's own clock (timer)."""
    clock: Literal["realtime", "lockstep"] = "realtime"
    """Real time, or lockstep with the emulator: as fast as it goes, the same bits each time."""
    duration_s: Seconds | None = None
    """The run stops after this time; left out: it goes on until it is stopped."""
    feedback_timeout_us: Annotated[int, Field(ge=10, le=100_000)] | None = None
    """How long after its deadline a tick waits for feedback; left out: 0.6 of the period."""
    max_gap_ticks: Annotated[int, Field(ge=1, le=64)] = 20
    """The run ends (LOOP_OVERRUN) when the loop is late by more periods than this."""
    shadow: bool = False
    """Listen and compute beside another controller, and send nothing."""

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
    """Priority of the loop under SCHED_FIFO; 0: the system's usual scheduling."""
    cpu: Annotated[int, Field(ge=0, le=4095)] | None = None
    """Number of the processor that the loop stays on; left out: any."""
    lock_memory: bool = True
    """Keep all memory of the loop's process in RAM (mlockall)."""


class GuardianTable(Table):
    """The process that stops the drive when the loop falls silent for longer than any tolerated skip."""

    enabled: bool = True
    """Start the guardian beside the loop."""
    timeout_ms: Annotated[float, Field(ge=1, le=MOST_GUARDIAN_MS, allow_inf_nan=False)] | None = None
    """Silence of the loop after which it stops the drive; left out: five periods above loop.max_gap_ticks, at
    least 10 ms."""

    def timeout_ns(self, loop: LoopTable) -> int:
        """Default: five periods more than the gap at which the supervisor stops, at least 10 ms."""
        if self.timeout_ms is not None:
            return round(self.timeout_ms * 1e6)
        return max((loop.max_gap_ticks + 5) * loop.period_ns, 10_000_000)


class BusTable(Table):
    """The CAN bus, in python-can's terms."""

    interface: str = "hil-local"
    """Interface of python-can: hil-local (this machine alone), socketcan, kvaser, pcan and others."""
    channel: str = "demo"
    """Channel of that interface: any name for hil-local, vcan0 or can0 for socketcan."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    """Bits a second of the arbitration phase, for interfaces that set it, and for the bus load."""
    data_bitrate: Annotated[int, Field(ge=10_000, le=8_000_000)] | None = None
    """Bits a second of the data phase of CAN FD; left out: as bitrate."""
    fd: bool = False
    """CAN FD."""
    sync: Literal["loop", "kernel"] = "loop"
    """Who sends SYNC: the loop, or the kernel by its own timer (socketcan alone, in real time)."""


Takes = Literal["voltage", "current", "torque"]


@dataclass(frozen=True, slots=True)
class Command:
    """What the drive takes: unit, the largest command and its largest change in a tick, and their keys."""

    takes: Takes
    unit: str
    most: float
    step: float
    keys: tuple[str, str]


class FirstOrderFilter(Table):
    """The drive's speed through a first-order lag."""

    kind: Literal["first-order"]
    pole_rad_s: Positive
    """Pole p of y' = p (w - y)."""
    modelled: bool = True
    """The observer takes the filter into its model; false: it does not, and the loop must bear it."""


class PllFilter(Table):
    """The drive's speed by a PLL of two real poles p, q: y'' + (p + q) y' + p q y = p q w."""

    kind: Literal["pll"]
    pole_1_rad_s: Positive
    """First pole; of gains k_p, k_i it is (k_p - (k_p^2 - 4 k_i)^1/2) / 2."""
    pole_2_rad_s: Positive
    """Second pole, (k_p + (k_p^2 - 4 k_i)^1/2) / 2; a critically damped PLL has both alike."""
    modelled: bool = True
    """The observer takes the filter into its model; false: it does not, and the loop must bear it."""


class MovingAverageFilter(Table):
    """The drive's speed as the mean over a window: the angle turned in it over its length."""

    kind: Literal["moving-average"]
    window_ms: Positive
    """Length of the window; a whole number of periods, up to 32."""
    modelled: bool = True
    """The observer takes the filter into its model; false: it does not, and the loop must bear it."""


class NoFilter(Table):
    """The drive reports the speed as it is."""

    kind: Literal["none"]


def _a_table(value: Any) -> Any:
    """A filter is a table; a name alone says too little."""
    if isinstance(value, (Table, dict)):
        return value
    raise ValueError('must be a table, as { kind = "first-order", pole_rad_s = 1000.0 }')


SpeedFilterTable = Annotated[
    FirstOrderFilter | PllFilter | MovingAverageFilter | NoFilter,
    Field(discriminator="kind"),
    BeforeValidator(_a_table),
]


FILTERS: Final = ("first-order", "pll", "moving-average", "none")
"""Kinds of :data:`SpeedFilterTable`."""


class DriveTable(Table):
    """The drive: its DBC and node, and of one with a current loop of its own what that makes of a command."""

    dbc: str
    """Path of the drive's DBC file, relative to this file."""
    kind: str = "dbc"
    """How frames are exchanged: dbc, by SYNC or the drive's clock; or a package's entry point hil.drive."""
    node_id: Annotated[int, Field(ge=0, le=255)] = 1
    """Number of the drive on the bus; it moves the identifiers of the DBC as node_rule says."""
    node_rule: str = ""
    """Where the node's number goes in identifiers, as "id << 5", or "moteus"; empty: CANopen's."""
    heartbeat_timeout_s: Annotated[float, Field(ge=1e-3, le=3600, allow_inf_nan=False)] = 3.0
    """How long to listen for the drive before arming, and in hil check."""
    signals: dict[str, Any] | None = None
    """Which signal of the DBC plays which part; left out: the house protocol (docs/protocol.md)."""
    current_lag_ms: Annotated[float, Field(ge=0, le=1e4, allow_inf_nan=False)] = 0.0
    """Time constant of the drive's own current loop; 0: it follows at once."""
    delay_ticks: Annotated[int, Field(ge=0, le=8)] = 0
    """Ticks by which a command acts later than with the next latch."""
    torque_constant_n_m_a: Positive | None = None
    """By what the drive makes a current of a torque; left out: the motor's constant."""
    rated_torque_n_m: Positive | None = None
    """What a torque in per mille is of (CiA 402: 6076h)."""
    rated_current_arms: Positive | None = None
    """What a current in per mille is of (CiA 402: 6075h)."""
    current_limit_a: Positive | None = None
    """Limit of i_q that is set in the drive: what it cuts off would read as load."""
    speed_filter: SpeedFilterTable = NoFilter(kind="none")
    """What the drive does to the speed before it reports it (docs/theory.md, the drive's speed filter)."""

    @property
    def takes(self) -> Takes:
        """What the drive takes, by the parts that its map has."""
        return takes_of(self.signals)


def takes_of(signals: Any) -> Takes:
    """What a drive of that map takes."""
    parts = signals if isinstance(signals, Mapping) else {}
    return "torque" if parts.get("torque_ref") else "current" if parts.get("i_q_ref") else "voltage"


def _annotation(key: Key) -> tuple[Any, Any]:
    """Type and default of a member's key, as pydantic takes them."""
    if key.type == "flag":
        return bool, Field(key.default, description=key.doc)
    most = MOST if key.most is None else key.most
    least = LEAST if key.least is None and key.above == 0.0 else key.least
    bounds: Any = Field(gt=key.above, ge=least, le=most, allow_inf_nan=False)
    kind: Any = Annotated[float, bounds]
    if key.type == "numbers":
        kind = Annotated[list[kind], Field(min_length=1, max_length=key.count)]
    given = ... if key.default is REQUIRED else key.default
    more: Any = {"x-unit": key.unit} if key.unit else None
    about = Field(given, description=key.doc, json_schema_extra=more)
    return kind | None if given is None else kind, about


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


ANTICOGGING = (
    "Load torque over the angle to compensate: a file of hil identify --steps cogging; left out: none."
)
COUPLING = "Reluctance torque and cross-coupling are known terms; false: the observers find them."
if typing.TYPE_CHECKING:
    ChannelTable = Any
    ControllerTable = Any
else:
    ChannelTable = _tables(observers(), "Observer", {})
    """One channel's observer: a table of each registered kind (:mod:`hil.control.observers`)."""
    ControllerTable = _tables(
        laws(),
        "Controller",
        {
            "compensate_coupling": (bool, Field(True, description=COUPLING)),
            "anticogging": (
                Annotated[AnticoggingTable | None, BeforeValidator(included)],
                Field(None, description=ANTICOGGING),
            ),
        },
    )
    """The control law: a table of each registered kind (:mod:`hil.control.laws`)."""


class ObserverTable(Table):
    """The disturbance observer of the speed channel and of both current channels.

    A drive with a current loop of its own has no observer of the currents.
    """

    speed: ChannelTable
    """Observer of the load torque, in the speed channel."""
    current: ChannelTable | None = None
    """Observer of the voltage errors, in both current channels; a drive that takes a current or a torque has
    none."""


class LimitsTable(Table):
    """What must never be exceeded. There are no defaults for the first five: a user decides them.

    ``u_max_v`` and ``du_max_v`` are of a drive that takes voltages; ``di_max_a`` of one that takes a current,
    ``dtorque_max_n_m`` of one that takes a torque: the largest change of the command in a tick.
    """

    w_max_rad_s: Positive
    """Largest speed |w|; above it for trip_ticks the run ends (OVER_SPEED)."""
    i_max_a: Positive
    """Largest current that the law asks for."""
    i_trip_a: Positive
    """Current (i_q^2 + i_d^2)^1/2 above which the run ends (OVER_CURRENT); above i_max_a."""
    u_max_v: Positive | None = None
    """Radius of the voltage circle that no command leaves; at most V_dc / sqrt(3) can be had. Needed
    by a drive that takes voltages, as du_max_v."""
    du_max_v: Positive | None = None
    """Largest change of u_q and of u_d from one tick to the next."""
    di_max_a: Positive | None = None
    """Largest change of i_q* from one tick to the next; needed by a drive that takes a current."""
    torque_max_n_m: Positive | None = None
    """Largest torque that the drive is asked for; left out: what it makes of i_max_a."""
    dtorque_max_n_m: Positive | None = None
    """Largest change of the torque from one tick to the next; needed by a drive that takes a torque."""
    T_L_max_n_m: NonNegative = 0.0
    """Largest torque that may be commanded to a load machine (kind fac); 0: none."""
    v_dc_min_v: NonNegative = 0.0
    """DC link below which the run ends (DC_LINK_UNDER_VOLTAGE)."""
    v_dc_max_v: Positive = 1e4
    """DC link above which the run ends (DC_LINK_OVER_VOLTAGE)."""
    temperature_max_c: Annotated[float, Field(ge=-273.15, le=1e4, allow_inf_nan=False)] = 120.0
    """Temperature of motor or inverter above which the run ends (OVER_TEMPERATURE)."""
    i_continuous_a: Positive | None = None
    """Current that the motor bears for ever; i2t counts from it. Left out: i_max_a."""
    i2t_max_a2s: Positive | None = None
    """Largest sum of i^2 - i_continuous^2 over time (I2T); left out: no such limit."""
    power_window_s: Annotated[float, Field(ge=1e-3, le=1e5, allow_inf_nan=False)] = 1.0
    """Time constant with which the sum of energy_max_j forgets."""
    energy_max_j: Positive | None = None
    """Largest electrical energy in or out within power_window_s (ENERGY); left out: no such limit."""
    applied_deviation_max_v: Positive | None = None
    """Largest distance of the voltage that the drive applies from the one sent, for guard_trip_ticks; left
    out: no such limit."""
    following_error_rad_s: Positive | None = None
    """Largest |w* - w| for following_error_s (FOLLOWING_ERROR); left out: no such limit."""
    following_error_s: Annotated[float, Field(ge=1e-6, le=3600, allow_inf_nan=False)] = 0.1
    """How long the following error may be too large."""
    i_d_max_a: Positive | None = None
    """|i_d - i_d*|, i_d* being 0 for most laws, may be above this in few ticks only (CURRENT_UNCONTROLLED);
    left out: no such limit."""
    open_phase_min_a: Positive | None = None
    """|i_d - i_d*| above this and above |i_q| / 3 in most ticks is an open phase (CURRENT_UNCONTROLLED);
    left out: not looked for."""
    trip_ticks: Annotated[int, Field(ge=1, le=1000)] = 3
    """Periods in a row for which a measured limit must be exceeded for the run to end."""
    guard_trip_ticks: Annotated[int, Field(ge=1, le=10**9)] = 200
    """Periods for which the guard may change the command before the run ends (GUARD_PERSISTENT)."""
    soft_start_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] = 0.0
    """Time in which the voltage circle grows from 0 to u_max_v after enabling."""

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
    """Periods without fresh feedback, or with an old echo, that are ridden out (STALE_FEEDBACK,
    COMMAND_LOST)."""
    period_ms: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] | None = None
    """How often the drive measures, where that is less often than the loop ticks: a whole multiple of its
    period. hold_ticks then count from when a measurement was due. Left out: in each tick."""
    quick_stop_ticks: Annotated[int, Field(ge=1, le=10_000)] = 20
    """Periods of a quick stop without feedback after which it ends as a fault."""
    error_budget: Annotated[int, Field(ge=1, le=10_000)] = 8
    """Damaged, repeated or lost frames that are ridden out; each good tick forgives a quarter of one."""
    frozen_ticks: Annotated[int, Field(ge=1, le=10_000)] = 5
    """Periods of equal readings although the voltage moved after which the run ends (FROZEN_FEEDBACK)."""
    repeat_ticks: Annotated[int, Field(ge=2, le=10_000)] | None = None
    """The same for a turning motor at constant voltage, where the sensors are known to be noisy; left out:
    not looked for."""
    enable_timeout_s: Annotated[float, Field(ge=1e-3, le=3600, allow_inf_nan=False)] = 2.0
    """Time in which the drive must reach operation once it is asked to (ENABLE_TIMEOUT)."""
    status_timeout_s: Annotated[float, Field(ge=1e-3, le=3600, allow_inf_nan=False)] | None = None
    """Age that a slow message of the drive may reach; by default from its cycle time in the DBC."""


class StepReference(Table):
    """w* jumps from 0 to ``w_rad_s`` at ``at_s``."""

    kind: Literal["step"]
    w_rad_s: Speed
    """Speed w* after the step."""
    at_s: Since = 0.0
    """When it steps."""
    i_q_a: Finite = 0.0
    """Current i_q*, for the paper's own law (controller.kind fac) alone."""


class RampReference(Table):
    """w* ramps to ``w_rad_s`` with ``rate_rad_s2``, and back to 0 from ``down_at_s`` on."""

    kind: Literal["ramp"]
    w_rad_s: Speed
    """Speed w* after the ramp."""
    rate_rad_s2: Positive
    """Slope of the ramp."""
    at_s: Since = 0.0
    """When it begins."""
    down_at_s: Since | None = None
    """When the ramp back to 0 begins; left out: never."""
    i_q_a: Finite = 0.0
    """Current i_q*, for the paper's own law (controller.kind fac) alone."""


class SCurveReference(Table):
    """Jerk-limited ramp to ``w_rad_s``, and back to 0 from ``down_at_s`` on."""

    kind: Literal["s-curve"]
    w_rad_s: Speed
    """Speed w* after the ramp."""
    rate_rad_s2: Positive
    """Largest slope."""
    jerk_rad_s3: Positive
    """Slope of the slope."""
    at_s: Since = 0.0
    """When it begins."""
    down_at_s: Since | None = None
    """When the way back to 0 begins; left out: never."""
    i_q_a: Finite = 0.0
    """Current i_q*, for the paper's own law (controller.kind fac) alone."""


class SineReference(Table):
    """w* = offset + amplitude sin(2 pi f t)."""

    kind: Literal["sine"]
    offset_rad_s: Speed = 0.0
    """Mean of w*."""
    amplitude_rad_s: Speed
    """Amplitude of w*."""
    frequency_hz: Positive
    """Frequency f."""
    i_q_a: Finite = 0.0
    """Current i_q*, for the paper's own law (controller.kind fac) alone."""


class TableReference(Table):
    """Piecewise linear through (t, w) points."""

    kind: Literal["table"]
    t_s: Annotated[list[Since], Field(min_length=2, max_length=256)]
    """Times of the points, increasing."""
    w_rad_s: Annotated[list[Speed], Field(min_length=2, max_length=256)]
    """Speed w* at those times; constant before the first and after the last."""
    i_q_a: Finite = 0.0
    """Current i_q*, for the paper's own law (controller.kind fac) alone."""

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
    """Slope of the ramp to rest; 0: stop at once. Left out: w_max_rad_s in a second, at most half of what the
    motor's torque gives."""
    ramp_max_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    """The drive is stopped after this time, at rest or not."""


class SetpointTable(Table):
    """What ``hil set`` may ask of a running run; left out: 0.9 of the limit, by the stop's ramp."""

    enabled: bool = True
    """Take set-points of hil set at all."""
    w_min_rad_s: Finite | None = None
    """Least speed that may be asked for; left out: -0.9 of limits.w_max_rad_s."""
    w_max_rad_s: Finite | None = None
    """Largest speed that may be asked for; left out: 0.9 of limits.w_max_rad_s."""
    rate_rad_s2: Positive | None = None
    """Slope on the way to a new speed; left out: that of stop.ramp_rad_s2."""
    i_q_max_a: Positive | None = None
    """Largest |i_q| that may be asked for (kind fac); left out: 0.9 of limits.i_max_a."""
    i_q_rate_a_s: Positive | None = None
    """Slope on the way to a new i_q; left out: limits.i_max_a in a second."""


class LogTable(Table):
    """Where the log goes."""

    folder: str = "../logs"
    """Folder of the logs, relative to this file."""
    name: str | None = None
    """Name of the log file; left out: this file's name and the time (UTC)."""
    frames: bool = True
    """Log every CAN frame beside the ticks."""
    compression: Literal["zstd", "lz4"] = "zstd"
    """Compression of the chunks."""
    split_s: Annotated[float, Field(ge=1, le=1e7, allow_inf_nan=False)] | None = None
    """Begin a new file after this time; left out: one file."""
    split_mb: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)] | None = None
    """Begin a new file after this size; left out: one file."""


class CriteriaTable(Table):
    """What a run must reach, judged by ``hil report``; every one is the largest value that passes."""

    tracking_rms_max_rad_s: NonNegative | None = None
    """Tracking error w* - w, rms."""
    dip_max_rad_s: NonNegative | None = None
    """Worst dip of the speed after a load step."""
    recovery_max_s: NonNegative | None = None
    """Slowest recovery to 0.5 rad/s after a load step."""
    rise_max_s: NonNegative | None = None
    """Slowest rise from 10 to 90 %."""
    overshoot_max_percent: NonNegative | None = None
    """Largest overshoot."""
    settling_max_s: NonNegative | None = None
    """Slowest settling to 2 %."""
    estimate_error_max_n_m: NonNegative | None = None
    """Load estimate off the true load, N ticks after a step."""
    ripple_max_rad_s: NonNegative | None = None
    """Speed ripple at rest, rms."""
    iae_max_rad: NonNegative | None = None
    """Integral of |w - w*|."""
    skipped_max: Annotated[int, Field(ge=0, le=10**15)] | None = None
    """Periods that the loop skipped."""
    dropped_max: Annotated[int, Field(ge=0, le=10**15)] | None = None
    """Records that the log dropped."""
    lost_feedback_max: Annotated[int, Field(ge=0, le=10**15)] | None = None
    """Ticks in operation without fresh feedback."""
    crc_errors_max: Annotated[int, Field(ge=0, le=10**15)] | None = None
    """Ticks with a CRC error."""
    lateness_p999_max_us: NonNegative | None = None
    """Lateness of the ticks, 99.9th percentile."""
    lateness_max_us: NonNegative | None = None
    """Lateness of the latest tick."""
    bus_load_max_percent: NonNegative | None = None
    """Bus load in the busiest second."""


class EmulatorTable(Table):
    """The emulated drive that belongs to this run; its parameters are in its own file."""

    plant: str
    """Path of the emulated drive's file, relative to this file."""


def _cascade() -> Any:
    """The controller of a config that names none."""
    adapter: Any = TypeAdapter(ControllerTable)
    return adapter.validate_python({"kind": "cascade"})


_OBJECT = r"^(0x)?[0-9A-Fa-f]{4}h?((:|sub)[0-9A-Fa-f]{1,2}h?)?$"
Objects = Annotated[list[Annotated[str, Field(pattern=_OBJECT)]], Field(min_length=1, max_length=8)]


class CanopenTable(Table):
    """A CANopen CiA 402 drive that hil configure sets up by SDO; its node is drive.node_id."""

    eds: str
    """Path of the drive's EDS or DCF, relative to this file."""
    mode: Literal["cst", "csv", "csp"] = "cst"
    """Cyclic synchronous torque, velocity or position (6060h)."""
    heartbeat_ms: Annotated[int, Field(ge=1, le=65535)] = 100
    """Period of the drive's heartbeat (1017h)."""
    rpdo: Annotated[list[Objects], Field(min_length=1, max_length=4)] | None = None
    """Objects of each PDO to the drive, as [["6040", "6071"]]; left out: the mode's own."""
    tpdo: Annotated[list[Objects], Field(min_length=1, max_length=4)] | None = None
    """Objects of each PDO from the drive, as [["6041", "606C", "6077"]]; left out: the mode's own."""
    sync_period: bool = False
    """Write the period of SYNC (1006h), for drives that want to know it."""
    rpdo_timeout_ms: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Deadline of the command (1400h:5), the drive's own watchdog where it has one; left out: not written."""
    velocity_unit: str = ""
    """What 606Ch counts in where 60A9h does not tell: "rpm", "0.001 rpm", "1/4096 rev/s"."""
    rated_current: Literal["rms", "peak"] | None = None
    """What the drive's rated current (6075h) is; needed where 6078h is mapped."""
    answer_timeout_s: Annotated[float, Field(ge=0.01, le=60, allow_inf_nan=False)] = 0.5
    """How long the drive may take to answer an SDO request."""


class FaultsTable(Table):
    """What `hil faults` expects of this configuration: by row, in place of what the shipped matrix does."""

    expect: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """What must come of a row, by its name (keys: faults:row.expect)."""


class RunConfig(Table):
    """Everything a run needs."""

    loop: LoopTable = LoopTable()
    realtime: RealtimeTable = RealtimeTable()
    guardian: GuardianTable = GuardianTable()
    bus: BusTable = BusTable()
    drive: DriveTable
    motor: Annotated[MotorTable, BeforeValidator(included)]
    controller: ControllerTable = Field(default_factory=_cascade)
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
        if self.loop.pacing == "timer" and known:
            return (
                f'{said}: with loop.pacing = "timer" the measurements slip from tick to tick, and the states '
                'of drive.speed_filter are not to be known; take "feedback"'
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
        problems = [_describe(problem, model) for problem in error.errors()]
        raise ConfigError(where, [*problems, *more]) from None
    if more:
        raise ConfigError(where, more)
    return made


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
    kinds["speed_filter"] = FILTERS
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
            for m in models_in(owner.model_fields[part].annotation)
        ]
        models = found or [m for m in models if part in _tags(m)] or models
    return [key for m in models for key in m.model_fields]


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The tables that a field's type may be."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is not None:
        return [m for a in typing.get_args(annotation) for m in models_in(a)]
    return []


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    kind = model.model_fields.get("kind")
    return typing.get_args(kind.annotation) if kind else ()
