"""Tables of the drive: its frames, its own current loop and speed filter, CANopen, and the emulated one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field

from hil.config.table import Positive, Table

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


class EmulatorTable(Table):
    """The emulated drive that belongs to this run; its parameters are in its own file."""

    plant: str
    """Path of the emulated drive's file, relative to this file."""


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
    position_unit: str = ""
    """What 6064h counts in where neither 60A8h nor 608Fh tell, or a gear stands between: "1/4096 rev"."""
    rated_current: Literal["rms", "peak"] | None = None
    """What the drive's rated current (6075h) is; needed where 6078h is mapped."""
    answer_timeout_s: Annotated[float, Field(ge=0.01, le=60, allow_inf_nan=False)] = 0.5
    """How long the drive may take to answer an SDO request."""
