"""Which frame and signal of a DBC plays which part: how any drive is driven by the same client.

A map names ``MESSAGE.Signal`` for each part; scale and offset are the DBC's, units are converted here and
nowhere else. Binding a map to a DBC checks it whole, and names all mistakes at once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from drivers.codec import Database
from drivers.errors import DatabaseError
from drivers.oneshot import OneShot, shots_from
from drivers.units import ANGLE, CELSIUS, CURRENT, DRIVE_TORQUE, SPEED, TORQUE, VOLTAGE

PLAIN: Final[dict[str, float]] = {}
STATUSWORD: Final = "statusword"
OFF: Final = -1
STATES: Final = {
    "not ready to switch on": 0,
    "switch on disabled": 1,
    "ready to switch on": 2,
    "switched on": 3,
    "operation enabled": 4,
    "quick stop active": 5,
    "fault reaction active": 6,
    "fault": 7,
    "off": OFF,
}


@dataclass(frozen=True, slots=True)
class Part:
    """What a part is: the tick's field, accepted units with their factor to SI, and whether it has a sign."""

    field: str
    units: Mapping[str, float]
    signed: bool = False


RECEIVED: Final[dict[str, Part]] = {
    "speed": Part("w", SPEED, True),
    "i_q": Part("i_q", CURRENT, True),
    "i_d": Part("i_d", CURRENT, True),
    "torque": Part("i_q", DRIVE_TORQUE, True),
    "angle": Part("theta", ANGLE),
    "echo": Part("echo", PLAIN),
    "state": Part("drive_state", PLAIN),
    "limited": Part("limited", PLAIN),
    "v_dc": Part("v_dc", VOLTAGE),
    "error": Part("drive_error", PLAIN),
    "temperature_motor": Part("temperature_motor", CELSIUS),
    "temperature_inverter": Part("temperature_inverter", CELSIUS),
    "load_true": Part("T_L_true", TORQUE, True),
}
SENT: Final[dict[str, Part]] = {
    "controlword": Part("controlword", PLAIN),
    "enable": Part("", PLAIN),
    "reset": Part("", PLAIN),
    "u_q": Part("u_q", VOLTAGE, True),
    "u_d": Part("u_d", VOLTAGE, True),
    "i_q_ref": Part("u_q", CURRENT, True),
    "i_d_ref": Part("u_d", CURRENT, True),
    "torque_ref": Part("u_q", DRIVE_TORQUE, True),
    "load_torque": Part("T_L", TORQUE, True),
    "load_enable": Part("", PLAIN),
}
MEASURED: Final = ("speed", "i_q", "i_d", "torque", "angle")
COMMANDED_Q: Final = ("torque_ref", "i_q_ref", "u_q")
COMMANDED_D: Final = ("u_d", "i_d_ref")
"""Parts of the command, by what the drive takes; it takes one of the first."""
REQUIRED: Final = {
    "u_q": ("speed", "i_q", "i_d", "state", "u_q", "u_d"),
    "i_q_ref": ("speed", "i_q_ref"),
    "torque_ref": ("speed", "torque_ref"),
}
"""What a map must have, by what the drive takes."""
NO_KEYS: Final = ("pole_pairs", "k_t", "rated_torque", "rated_current")
"""Of a map what the configuration says elsewhere."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveMap:
    """A drive's parts as ``MESSAGE.Signal``; ``sync``, ``emergency``, ``heartbeat`` and ``nmt`` name
    messages.

    An empty part is not there. ``counters``: the frame counter of each message that has one. ``constants``:
    signals that are always sent with a value. ``units``: the unit of a part (or ``MESSAGE.Signal``) for which
    the DBC has another, none or an unknown one. ``pole_pairs``: for electrical speeds; ``k_t`` [N m/A]: for a
    torque in place of i_q; ``rated_torque`` [N m], ``rated_current`` [A]: for values in per mille.
    ``states``: CiA 402's name for each raw value of ``state``, or "statusword" to decode CiA 402's; empty
    when the values are hil's own. A state named "off" reads as what the last controlword leads to short of
    operation, for drives that know only on and off. A drive without a state is taken to be where the command
    leads.
    """

    speed: str = ""
    """Mechanical speed w, or electrical, as its unit in the DBC says."""
    i_q: str = ""
    """Current i_q."""
    i_d: str = ""
    """Current i_d."""
    torque: str = ""
    """Torque in place of i_q, of a drive that takes a current or a torque."""
    angle: str = ""
    """Mechanical angle of the shaft, from a mark that stays; counted on over turns or not."""
    state: str = ""
    """State of the drive; see states."""
    u_q: str = ""
    """Voltage command u_q."""
    u_d: str = ""
    """Voltage command u_d."""
    i_q_ref: str = ""
    """Current command i_q*, of a drive that takes a current."""
    i_d_ref: str = ""
    """Current command i_d*, which is held at 0."""
    torque_ref: str = ""
    """Torque command, of a drive that takes a torque."""
    controlword: str = ""
    """CiA 402 controlword; or enable."""
    enable: str = ""
    """One bit that enables the drive, where it has no controlword."""
    reset: str = ""
    """One bit that resets a fault, beside enable."""
    echo: str = ""
    """Counter of the command that the drive now applies."""
    limited: str = ""
    """The drive limits the voltage itself."""
    v_dc: str = ""
    """DC link."""
    error: str = ""
    """Error code."""
    temperature_motor: str = ""
    """Temperature of the motor."""
    temperature_inverter: str = ""
    """Temperature of the inverter."""
    load_true: str = ""
    """True load torque, of an emulator."""
    load_torque: str = ""
    """Torque command to a load machine (kind fac)."""
    load_enable: str = ""
    """Enable of the load machine."""
    sync: str = ""
    """Message that begins the drive's cycle."""
    poll: str = ""
    """Message of the command, of a drive that answers it alone: it is sent in SYNC's place."""
    emergency: str = ""
    """Emergency message of the drive."""
    heartbeat: str = ""
    """Heartbeat of the drive."""
    on_value: int = 1
    """Raw value of enable that switches the drive on."""
    off_value: int = 0
    """Raw value of enable that switches the drive off."""
    on_change: tuple[str, ...] = ()
    """Messages of the command that are sent when they change and with each stop, not in each tick."""
    start: tuple[OneShot, ...] = ()
    """Frames that are sent once after arming, before the first command, each with what it waits for."""
    stop: tuple[OneShot, ...] = ()
    """Frames that are sent once after the stop frames."""
    step: str = ""
    """Message that moves an emulated drive without SYNC on by a period, in lockstep alone."""
    nmt: str = ""
    """CANopen's NMT message: the drive's node is started after arming, and every stop leaves operation."""
    counters: tuple[str, ...] = ()
    """Frame counters, one for each message that has one."""
    cycle_ms: Mapping[str, float] = field(default_factory=dict)
    """How often the drive sends a message, where it is set to another rate than the DBC says."""
    constants: Mapping[str, int | float] = field(default_factory=dict)
    """Signals that are always sent with a value, by MESSAGE.Signal."""
    expect: Mapping[str, int] = field(default_factory=dict)
    """Raw number that a signal of a received message must have, by MESSAGE.Signal, or it is not taken."""
    unwatched: bool = False
    """Command a mode of the drive in which it never misses its master (attribute Unwatched in the DBC)."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Unit of a part or a MESSAGE.Signal for which the DBC has another, none or an unknown one."""
    pole_pairs: int | None = None
    """Pole pairs, for electrical speeds."""
    k_t: float | None = None
    """Torque constant of the drive, for a torque in place of i_q."""
    rated_torque: float | None = None
    """Rated torque, for torques in per mille."""
    rated_current: float | None = None
    """Rated current (peak), for currents in per mille."""
    states: Mapping[int, str] | str = field(default_factory=dict)
    """CiA 402's name for each raw value of state, or "statusword"."""

    @property
    def required(self) -> tuple[str, ...]:
        """Parts that it must have."""
        return REQUIRED[next((part for part in COMMANDED_Q if getattr(self, part)), "u_q")]


def completed(parts: DriveMap, *, lockstep: bool, **facts: Any) -> DriveMap:
    """The map with what the configuration says elsewhere (NO_KEYS).

    In lockstep an emulated drive without SYNC is moved on by its own message.
    """
    return replace(parts, sync=parts.step if lockstep and not parts.sync else parts.sync, **facts)


def map_of(table: Mapping[str, Any] | None, database: Database, where: str, **facts: Any) -> DriveMap:
    """The map of a configuration's table, :func:`completed`; without one the house protocol's.

    Raises DatabaseError.
    """
    return house_map(database) if table is None else completed(map_from_table(table, where), **facts)


def house_map(database: Database) -> DriveMap:
    """The map of the house protocol, classic or FD. Raises DatabaseError when the DBC is another one."""
    feedback = database.optional("FEEDBACK")
    status = "FEEDBACK" if database.optional("STATUS") is None else "STATUS"
    load = "COMMAND" if database.optional("LOAD_COMMAND") is None else "LOAD_COMMAND"
    counted = dict.fromkeys(("FEEDBACK", "COMMAND", status, load))
    truth, emergency, heartbeat = (
        name if database.optional(name) else "" for name in ("TRUTH", "EMCY", "HEARTBEAT")
    )
    return DriveMap(
        speed="FEEDBACK.Speed",
        i_q="FEEDBACK.CurrentQ",
        i_d="FEEDBACK.CurrentD",
        angle="FEEDBACK.Angle" if feedback and "Angle" in feedback.signals else "",
        state="FEEDBACK.State",
        echo="FEEDBACK.Echo",
        limited="FEEDBACK.Limited",
        v_dc=f"{status}.DcLinkVoltage",
        error=f"{status}.ErrorCode",
        temperature_motor=f"{status}.TemperatureMotor",
        temperature_inverter=f"{status}.TemperatureInverter",
        load_true="TRUTH.LoadTorqueTrue" if truth else "",
        controlword="COMMAND.Controlword",
        u_q="COMMAND.VoltageQ",
        u_d="COMMAND.VoltageD",
        load_torque=f"{load}.LoadTorque",
        load_enable="COMMAND.LoadEnable" if load == "COMMAND" else "LOAD_COMMAND.Enable",
        counters=tuple(f"{name}.Counter" for name in counted),
        sync="SYNC",
        emergency=emergency,
        heartbeat=heartbeat,
    )


def map_from_table(table: Mapping[str, Any], where: str) -> DriveMap:
    """A map from a config's ``[drive.signals]``. Raises DatabaseError that names all mistakes."""
    fields = [one.name for one in dataclasses.fields(DriveMap) if one.name not in NO_KEYS]
    mistakes = [f"{key}: unknown; known are {', '.join(fields)}" for key in table if key not in fields]
    required = REQUIRED[next((part for part in COMMANDED_Q if table.get(part)), "u_q")]
    mistakes += [f'{name}: missing; name it as "MESSAGE.Signal"' for name in required if name not in table]
    values: dict[str, Any] = {}
    for key in table.keys() & set(fields):
        value = _value(key, table[key])
        if value is None:
            mistakes.append(f"{key}: {table[key]!r} is not of the form that it takes")
        values[key] = value
    if mistakes:
        raise DatabaseError(f"{where}: " + "; ".join(sorted(mistakes)))
    return DriveMap(**values)


def _value(key: str, value: Any) -> Any:
    """The value of one key in the map's type, None when it has another form."""
    if key in ("start", "stop"):
        return shots_from(value)
    if key in ("on_value", "off_value"):
        return value if type(value) is int and 0 <= value < 2**32 else None
    if key in ("counters", "on_change"):
        texts = isinstance(value, list | tuple) and all(isinstance(one, str) for one in value)
        return tuple(value) if texts else None
    if key == "states":
        if value == STATUSWORD:
            return value
        return _states(value) if isinstance(value, Mapping) else None
    if key == "constants":
        return _named(value, int | float)
    if key == "expect":
        return _named(value, int)
    if key == "cycle_ms":
        cycles = _named(value, int | float)
        return cycles if cycles and all(0.0 < one < math.inf for one in cycles.values()) else None
    if key == "unwatched":
        return value if isinstance(value, bool) else None
    if key == "units":
        return _named(value, str)
    return value if isinstance(value, str) else None


def _named(value: Any, kind: Any) -> dict[str, Any] | None:
    """A table of values of one kind by name, a signal's in quotes or not (TOML reads A.B = 1 as a table)."""
    if not isinstance(value, Mapping):
        return None
    flat: dict[str, Any] = {}
    for name, one in value.items():
        inner = one if isinstance(one, Mapping) else {"": one}
        flat |= {f"{name}.{signal}" if signal else str(name): given for signal, given in inner.items()}
    right = all(isinstance(one, kind) and not isinstance(one, bool) for one in flat.values())
    return flat if right else None


def _states(value: Mapping[Any, Any]) -> dict[int, str] | None:
    try:
        return {int(raw): str(name) for raw, name in value.items()}
    except (TypeError, ValueError):
        return None
