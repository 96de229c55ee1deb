"""Tables of the motor: what the controller believes, where it is from, and its load torque over the angle."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from hil.config.table import Finite, NonNegative, Positive, Table
from hil.control.cogging import MOST_ORDER, ORDERS, Harmonics
from hil.control.mtpa import POINTS


class IdentifiedTable(Table):
    """What ``hil identify`` adds to a motor: from when and what, 95 % intervals by the motor's keys, and the
    facts of bus and sensors.

    No run reads it; ``hil tune``, ``hil design`` and ``hil check`` do.
    """

    date: str
    """When it was identified, UTC."""
    drive: str
    """On which drive and bus."""
    logs: list[str] = Field([])
    """The runs that it was estimated from."""
    low: dict[str, Finite] = Field({})
    """Lower ends of the 95 % intervals, by the motor's keys and those of its coupling here."""
    high: dict[str, Finite] = Field({})
    """Upper ends of the 95 % intervals, by the motor's keys and those of its coupling here."""
    coulomb_n_m: NonNegative | None = None
    """Coulomb friction."""
    w_noise_rad_s: NonNegative | None = None
    """Noise of the measured speed, resolution included, standard deviation."""
    i_q_noise_a: NonNegative | None = None
    """Noise of the measured i_q, resolution included, standard deviation."""
    i_d_noise_a: NonNegative | None = None
    """Noise of the measured i_d, resolution included, standard deviation."""
    i_noise_a: NonNegative | None = None
    """Noise of both currents, of a file that does not tell them apart."""
    w_lsb_rad_s: NonNegative | None = None
    """Resolution of the measured speed."""
    i_q_lsb_a: NonNegative | None = None
    """Resolution of the measured i_q."""
    i_d_lsb_a: NonNegative | None = None
    """Resolution of the measured i_d."""
    arrival_ms: Finite | None = None
    """When a measurement comes after its tick's deadline, on average."""
    arrival_jitter_ms: NonNegative | None = None
    """Standard deviation of that."""
    L_q_saturation_a: Positive | None = None
    """Current i_q at which psi_q / i_q has fallen to half of L_q_h by saturation; left out: none was seen."""
    resonance_hz: Positive | None = None
    """Where a soft coupling resonates with both ends free; left out: none was seen, the shaft is rigid."""
    resonance_damping: Positive | None = None
    """Damping ratio of that resonance."""
    inertia_ratio: Positive | None = None
    """Inertia behind the coupling over the motor's own; J_kg_m2 is both."""
    delay_ticks: Annotated[int, Field(ge=0, le=100)] | None = None
    """Ticks from sending a voltage to its effect."""
    echo_lag_ticks: Annotated[int, Field(ge=-100, le=100)] | None = None
    """Ticks by which the echo of the commands is older than what acts; 0 for an honest one."""


class ShaftTable(Table):
    """An elastic shaft between motor and load that the observer takes into its model.

    What it does is then no part of the estimate, which is that of the torque on the load.
    """

    resonance_hz: Positive
    """Resonance of the two inertias, at most a quarter of ``loop.rate_hz``."""
    damping_ratio: Annotated[float, Field(ge=0, le=0.99, allow_inf_nan=False)] = 0.01
    """Damping of it."""
    inertia_ratio: Annotated[float, Field(ge=1e-3, le=1e3, allow_inf_nan=False)] = 1.0
    """Inertia of the load over that of the motor; J_kg_m2 is both."""


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
    shaft: ShaftTable | None = None
    """The elastic shaft to the load; left out: a rigid one."""
    identified: IdentifiedTable | None = None
    """Where the values come from, when hil identify found them."""


class IdTable(Table):
    """i_d* of a motor over the size of i_q*, linear between the points; for both signs of i_q*."""

    i_q_a: Annotated[list[NonNegative], Field(min_length=2, max_length=POINTS)]
    """Sizes of i_q*, ascending from 0."""
    i_d_a: Annotated[list[Finite], Field(min_length=2, max_length=POINTS)]
    """i_d* at each; past the last as there."""

    @model_validator(mode="after")
    def _rises(self) -> IdTable:
        if len(self.i_q_a) != len(self.i_d_a):
            raise ValueError(
                f"i_q_a has {len(self.i_q_a)} entries and i_d_a {len(self.i_d_a)}; give one i_d an i_q"
            )
        if self.i_q_a[0] != 0.0 or any(a >= b for a, b in zip(self.i_q_a, self.i_q_a[1:], strict=False)):
            raise ValueError("i_q_a must ascend from 0; sort the rows by i_q_a, each once")
        return self


class KnownLoadTable(Table):
    """Load torque that is known beforehand, against positive speed: T = k w |w| + G sin(theta - zero).

    The observer estimates what is left of the load, and the law asks for this without waiting for it.
    """

    quadratic_n_m_s2: NonNegative = 0.0
    """k, torque over the square of the speed: a fan or a pump."""
    gravity_n_m: NonNegative = 0.0
    """G, largest torque of a weight on an arm; the drive has to report the angle."""
    gravity_zero_rad: Finite = 0.0
    """Angle at which the weight hangs, its torque is 0 and grows with the angle."""

    @property
    def over_angle(self) -> Harmonics:
        """The part over the angle: order 1."""
        if not self.gravity_n_m:
            return Harmonics((), (), ())
        G, zero = self.gravity_n_m, self.gravity_zero_rad
        return Harmonics((1,), (-G * math.sin(zero),), (G * math.cos(zero),))


class AnticoggingTable(Table):
    """Load torque over the shaft's angle theta, as hil identify --steps cogging writes it:
    T_c = sum of cos_n_m cos(n theta) + sin_n_m sin(n theta) over the orders n."""

    date: str = ""
    """When it was learned, UTC."""
    drive: str = ""
    """On which drive and bus."""
    logs: list[str] = Field([])
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
    orders: Annotated[list[Annotated[int, Field(ge=1, le=MOST_ORDER)]], Field(max_length=ORDERS)] = Field([])
    """Periods in a turn of the shaft, ascending."""
    cos_n_m: list[Finite] = Field([])
    """Cosine coefficient of each order."""
    sin_n_m: list[Finite] = Field([])
    """Sine coefficient of each order."""
    error_n_m: list[NonNegative] = Field([])
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
