"""Configuration of the emulated drive: typed tables with units in the key names, turned into records.

Reading the file is left to the caller; this module knows only what a plant consists of.
"""

from __future__ import annotations

import typing
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from firmware_model.coupling import Coupling, Masses
from firmware_model.dialects import dialect, dialects
from firmware_model.faults import TURNING, ExtraLoad, Fault
from firmware_model.loads.step import StepLoad
from firmware_model.plant import MAX_LOADS, MOST_SLOTS, PARAMETERS, PARAMS, SAMPLE, STATE, State, code_of
from firmware_model.registry import loads
from firmware_model.tables import Finite, NonNegative, Positive, Table

Record = npt.NDArray[np.void]


class PlantMotor(Table):
    """The true motor."""

    name: str = ""
    """What the motor is called, for reports."""
    R_s_ohm: Positive
    """Resistance R_s of a phase."""
    L_d_h: Positive
    """Inductance L_d of the d axis."""
    L_q_h: Positive
    """Inductance L_q of the q axis."""
    L_q_saturation_a: Positive | None = None
    """Current i_q at which psi_q / i_q has fallen to half of L_q_h by saturation; left out: none."""
    psi_f_wb: Positive
    """Flux linkage psi_f of the magnets: peak phase voltage over electrical speed."""
    n_p: Annotated[int, Field(ge=1, le=100)]
    """Pole pairs n_p."""
    J_kg_m2: Positive
    """Moment of inertia J of motor and load together."""
    B_f_n_m_s: NonNegative = 0.0
    """Viscous friction B_f: torque over mechanical speed."""

    @property
    def k_t_n_m_a(self) -> float:
        """Torque over i_q without reluctance: 1.5 n_p psi_f."""
        return 1.5 * self.n_p * self.psi_f_wb


class Inverter(Table):
    """DC link and resolution of the modulator (0: none).

    Without ``capacitance_f`` the link stays at ``v_dc_v``. With it a rectifier of that no-load voltage feeds
    a capacitor, and what the motor gives back goes there, into the brake resistor from ``brake_on_v`` down
    to ``brake_off_v``; above ``v_dc_trip_v`` the drive trips.
    """

    v_dc_v: Positive = 540.0
    """DC link; with capacitance_f the no-load voltage of its rectifier."""
    resolution_v: NonNegative = 0.02
    """Resolution of the modulator; 0: none."""
    capacitance_f: Positive | None = None
    """Capacitor of the DC link; left out: the link stays at v_dc_v."""
    rectifier_ohm: Positive = 0.5
    """Resistance of the rectifier that feeds the capacitor."""
    brake_ohm: Positive | None = None
    """Brake resistor; left out: none."""
    brake_on_v: Positive | None = None
    """DC link at which the brake resistor is switched on."""
    brake_off_v: Positive | None = None
    """DC link at which the brake resistor is switched off again."""
    v_dc_trip_v: Positive | None = None
    """DC link above which the drive trips; left out: it does not."""

    @model_validator(mode="after")
    def _whole(self) -> Inverter:
        brake = (self.brake_ohm, self.brake_on_v, self.brake_off_v)
        more = [value for value in (*brake, self.v_dc_trip_v) if value is not None]
        if more and self.capacitance_f is None:
            raise ValueError(
                "brake_*_v, brake_ohm and v_dc_trip_v need capacitance_f; v_dc is constant without"
            )
        if any(value is not None for value in brake) and None in brake:
            raise ValueError("brake_ohm, brake_on_v and brake_off_v belong together")
        if self.brake_on_v and self.brake_off_v and not self.v_dc_v < self.brake_off_v < self.brake_on_v:
            raise ValueError("v_dc_v < brake_off_v < brake_on_v must hold, or the brake never rests")
        return self


class Friction(Table):
    """Dry friction of the shaft: T = sgn(w) (T_c + (T_s - T_c) e^{-|w| / w_s}); it sticks up to T_s."""

    coulomb_n_m: NonNegative = 0.0
    """Dry friction T_c of a shaft that slides."""
    static_n_m: NonNegative | None = None
    """Largest torque T_s that holds a shaft at rest; left out: as coulomb_n_m."""
    stribeck_rad_s: Positive = 1.0
    """Speed w_s with which friction falls from T_s to T_c."""

    @model_validator(mode="after")
    def _ordered(self) -> Friction:
        if self.static_n_m is not None and self.static_n_m < self.coulomb_n_m:
            raise ValueError("static_n_m is the larger one: at least coulomb_n_m")
        return self

    @property
    def most_n_m(self) -> float:
        """T_s."""
        return self.coulomb_n_m if self.static_n_m is None else self.static_n_m


class Sensors(Table):
    """Standard deviation of the noise on speed and currents; resolution and range are the wire's."""

    w_noise_rad_s: NonNegative = 0.0
    """Noise of the measured speed, standard deviation."""
    i_noise_a: NonNegative = 0.0
    """Noise of the measured currents, standard deviation."""


class FirstOrderFilter(Table):
    """The speed through a first-order lag."""

    kind: Literal["first-order"]
    pole_rad_s: Positive
    """Pole p of y' = p (w - y)."""


class PllFilter(Table):
    """The speed by a PLL of two real poles p, q: y'' + (p + q) y' + p q y = p q w."""

    kind: Literal["pll"]
    pole_1_rad_s: Positive
    """First pole; of gains k_p, k_i it is (k_p - (k_p^2 - 4 k_i)^1/2) / 2."""
    pole_2_rad_s: Positive
    """Second pole, (k_p + (k_p^2 - 4 k_i)^1/2) / 2; a critically damped PLL has both alike."""


class MovingAverageFilter(Table):
    """The mean speed over a window: the angle turned in it over its length."""

    kind: Literal["moving-average"]
    window_ms: Positive
    """Length of the window; a multiple of current_period_us, up to 1024 of them."""


class NoFilter(Table):
    """The speed as it is."""

    kind: Literal["none"]


def _a_table(value: Any) -> Any:
    """A filter is a table; a name alone says too little."""
    if isinstance(value, (Table, dict)):
        return value
    raise ValueError('must be a table, as { kind = "first-order", pole_rad_s = 1000.0 }')


Filters = Annotated[
    FirstOrderFilter | PllFilter | MovingAverageFilter | NoFilter,
    Field(discriminator="kind"),
    BeforeValidator(_a_table),
]


class Firmware(Table):
    """Protection of the drive itself."""

    watchdog_ms: Annotated[float, Field(ge=0, le=3.6e6, allow_inf_nan=False)] = 20.0
    """Time without a fresh valid command after which the drive stops itself; 0: never."""
    i_trip_a: Positive = 30.0
    """Current above which the drive trips."""
    w_trip_rad_s: Positive = 300.0
    """Speed above which the drive trips."""
    temperature_trip_c: Positive = 140.0
    """Temperature above which the drive trips."""
    ambient_c: Finite = 25.0
    """Ambient temperature, and the motor's at the start."""
    thermal_resistance_k_w: Positive = 0.5
    """Thermal resistance from winding to ambient."""
    thermal_time_s: Positive = 600.0
    """Time constant of the winding's temperature."""
    status_every: Annotated[int, Field(ge=1, le=10**6)] = 10
    """SYNCs from one status message to the next."""
    takes: Literal["voltage", "current", "torque"] = "voltage"
    """What a command is; for a current or a torque the drive has a current loop of its own."""
    current_loop_rad_s: Positive = 1000.0
    """Bandwidth of the drive's own current loop."""
    current_period_us: Annotated[int, Field(ge=1, le=100_000)] = 50
    """Sample time of the drive's own current loop."""
    speed_pll_rad_s: NonNegative = 0.0
    """Bandwidth of the critically damped PLL that the drive's speed comes from; 0: none. Short for a
    speed_filter of kind pll whose poles are alike."""
    speed_filter: Filters = NoFilter(kind="none")
    """What the drive's speed comes through."""
    i_limit_a: Positive | None = None
    """Limit of the current that the drive's own loop is asked for; left out: none."""
    torque_constant_n_m_a: Positive | None = None
    """By what the drive makes a current of a torque; left out: the motor's own constant."""

    @property
    def filtered_by(self) -> FirstOrderFilter | PllFilter | MovingAverageFilter | NoFilter:
        """What the drive's speed comes through, however it is given."""
        if pole := self.speed_pll_rad_s:
            return PllFilter(kind="pll", pole_1_rad_s=pole, pole_2_rad_s=pole)
        return self.speed_filter

    @model_validator(mode="after")
    def _one_filter(self) -> Firmware:
        if self.speed_pll_rad_s and not isinstance(self.speed_filter, NoFilter):
            raise ValueError(
                "speed_pll_rad_s and speed_filter: the speed comes through one of them; keep one"
            )
        if isinstance(self.speed_filter, MovingAverageFilter):
            slots = self.speed_filter.window_ms * 1e3 / self.current_period_us
            if not (1 <= round(slots) <= MOST_SLOTS and abs(slots - round(slots)) < 1e-6 * slots):
                raise ValueError(
                    f"speed_filter.window_ms = {self.speed_filter.window_ms:g}: no multiple of "
                    f"current_period_us = {self.current_period_us} from 1 to {MOST_SLOTS} of them"
                )
        return self


if typing.TYPE_CHECKING:
    Load = Any
    Spoken = str
else:
    Spoken = Literal[dialects()]
    """A protocol (:mod:`firmware_model.dialects`)."""
    _TABLES = tuple(member.table for member in loads().values())
    Load = Annotated[typing.Union[_TABLES], Field(discriminator="kind")]  # noqa: UP007 - of a tuple
    """A load: a table of each registered kind (:mod:`firmware_model.loads`)."""


class Disturbance(Table):
    """Unknown constants phi of (33)."""

    phi_w_rad_s2: Finite = 0.0
    """Constant in the speed equation."""
    phi_q_a_s: Finite = 0.0
    """Constant in the q current's equation."""


def included(value: Any, info: ValidationInfo) -> Any:
    """A table may be the path of a TOML file that holds it; the caller's context knows how to read it."""
    return info.context["include"](value) if isinstance(value, str) and info.context else value


def _as_step(fault: ExtraLoad) -> StepLoad:
    until_s = None if fault.for_s is None else fault.at_s + fault.for_s
    return StepLoad(kind="step", torque_n_m=fault.torque_n_m, at_s=fault.at_s, until_s=until_s)


SELDOM = ("house", "odrive")
"""Protocols whose measurements may go out in each so manieth cycle alone."""


class PlantConfig(Table):
    """The whole emulated drive."""

    dbc: str
    """Path of the DBC that the drive speaks, relative to this file."""
    node_id: Annotated[int, Field(ge=1, le=127)] = 1
    """Number of the drive on the bus."""
    protocol: Spoken = "house"
    """The house protocol (docs/protocol.md); inverter: CAN FD, 29-bit identifiers, no SYNC and no echo;
    cia402: CANopen, mute until hil configure has mapped its PDOs; odrive: CAN Simple; moteus: its
    register protocol over CAN FD; or a package's entry point hil.emulated."""
    eds: str = ""
    """Path of a CiA 402 drive's EDS, relative to this file."""
    pacing: Literal["sync", "cyclic"] = "sync"
    """The drive answers SYNC, or sends by its own clock (cyclic)."""
    feedback_every: Annotated[int, Field(ge=1, le=64)] = 1
    """It measures and tells in each so manieth cycle (SYNC, or its own clock's); protocols house and odrive.
    A CiA 402 drive goes by its TPDOs' transmission types."""
    substep_us: Annotated[int, Field(ge=1, le=100_000)] = 500
    """Longest step of the motor's Taylor series."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1
    """Seed of the sensors' noise."""
    truth: bool = True
    """Send the true load torque, for the report."""
    motor: Annotated[PlantMotor, BeforeValidator(included)]
    """The true motor: a table, or the path of a file."""
    inverter: Inverter = Inverter()
    """DC link and modulator."""
    sensors: Sensors = Sensors()
    """Noise of the sensors."""
    firmware: Firmware = Firmware()
    """Protection of the drive itself."""
    friction: Friction = Friction()
    """Dry friction of the shaft."""
    coupling: Coupling | None = None
    """A soft coupling between motor and load; left out: the shaft is rigid."""
    disturbance: Disturbance = Disturbance()
    """Unknown constants of (33)."""
    load: list[Load] = Field(default=[], max_length=MAX_LOADS)
    """Load torques on the shaft; they add up."""
    fault: list[Fault] = Field(default=[])
    """What goes wrong, and when."""
    black_box: bool = False
    """Keep what the drive did for hil faults to judge."""

    @property
    def masses(self) -> Masses:
        """The inertias before and behind the coupling."""
        J = self.motor.J_kg_m2
        return Masses(J) if self.coupling is None else self.coupling.masses(J)

    @property
    def all_loads(self) -> list[Any]:
        """The plant's loads and those that its faults add."""
        extra = [fault for fault in self.fault if isinstance(fault, ExtraLoad)]
        return [*self.load, *(_as_step(fault) for fault in extra)]

    @model_validator(mode="after")
    def _has_its_eds(self) -> PlantConfig:
        if bool(self.eds) != dialect(self.protocol).eds:
            raise ValueError('eds and a protocol that needs one, as "cia402", belong together')
        return self

    @model_validator(mode="after")
    def _fails_where_it_can(self) -> PlantConfig:
        """What turns a commanded voltage is undone at the next period of a current loop behind it."""
        turning = [fault.kind for fault in self.fault if isinstance(fault, TURNING)]
        if turning and self.firmware.takes != "voltage":
            raise ValueError(
                f"fault: {turning[0]}: acts on a commanded voltage, this drive takes a "
                f"{self.firmware.takes}; leave it out"
            )
        return self

    @model_validator(mode="after")
    def _has_two_ends(self) -> PlantConfig:
        try:
            _ = self.masses
        except ValueError as error:
            raise ValueError(f"coupling: {error}") from None
        return self

    @model_validator(mode="after")
    def _may_be_seldom(self) -> PlantConfig:
        if self.feedback_every > 1 and self.protocol not in SELDOM:
            raise ValueError(
                f"feedback_every = {self.feedback_every}: of protocols {', '.join(SELDOM)} alone"
            )
        return self

    @model_validator(mode="after")
    def _room_for_loads(self) -> PlantConfig:
        if len(self.all_loads) > MAX_LOADS:
            raise ValueError(f"more than {MAX_LOADS} loads with those of the faults")
        return self


@dataclass(frozen=True, slots=True)
class Wire:
    """Resolution and range of the measured signals on the wire (from the DBC)."""

    w_lsb: float
    w_top: float
    i_q_lsb: float
    i_q_top: float
    i_d_lsb: float
    i_d_top: float
    theta_lsb: float = 0.0
    """Of the shaft's angle; 0: it is not reported."""
    theta_counts: float = 0.0
    """Numbers of its counter, signed, which goes on over turns and then begins anew; 0: within a turn."""


def build_params(config: PlantConfig, wire: Wire) -> Record:
    """The parameter record of a plant: a one-element array of PARAMS."""
    p = np.zeros(1, PARAMS)
    fields: Any = p[0]
    for name, row in PARAMETERS.items():
        value = row.of(config, wire)
        fields[name] = np.inf if value is None else value
    for record, load in zip(p["load"][0], config.all_loads, strict=False):
        record["kind"] = code_of(load.kind)
        for name, number in loads()[load.kind].values(load).items():
            record[name] = number
    return p


def new_state(p: Record, echo_none: int) -> Record:
    """A drive that has just booted: standing still, SWITCH_ON_DISABLED, no command yet."""
    s = np.zeros(1, STATE)
    s["state"] = int(State.SWITCH_ON_DISABLED)
    s["echo"] = echo_none
    s["temperature"] = p["ambient"]
    s["v_dc"] = p["v_dc"]
    s["random"] = p["seed"]
    return s


def new_sample() -> Record:
    """An empty sample."""
    return np.zeros(1, SAMPLE)
