"""Tables of what must not be exceeded, of missing feedback, and of what a run must reach."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from hil.config.table import NonNegative, Positive, Table


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
    p_regen_max_w: NonNegative | None = None
    """Largest power that the law lets the motor give back to the DC link, by its model in steady state: it
    brakes with less current then, and more slowly than the reference may ask. Left out: no such limit."""
    v_dc_regen_from_v: Positive | None = None
    """DC link from which p_regen_max_w falls, to 0 at v_dc_regen_max_v; left out: it does not."""
    v_dc_regen_max_v: Positive | None = None
    """DC link to which nothing is given back any more; below v_dc_max_v."""
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
    following_error_rad: Positive | None = None
    """Largest |theta* - theta| of the law position for following_error_s (ANGLE_ERROR); needed by it."""
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

    @model_validator(mode="after")
    def _regenerating(self) -> LimitsTable:
        start, end = self.v_dc_regen_from_v, self.v_dc_regen_max_v
        if (start is None) != (end is None):
            raise ValueError("v_dc_regen_from_v and v_dc_regen_max_v belong together; give both or neither")
        if start is None or end is None:
            return self
        if self.p_regen_max_w is None:
            raise ValueError(
                "v_dc_regen_max_v needs p_regen_max_w, the power that falls from v_dc_regen_from_v; add it"
            )
        if not start < end < self.v_dc_max_v:
            raise ValueError(
                "v_dc_regen_from_v < v_dc_regen_max_v < v_dc_max_v must hold, or braking trips the run"
            )
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
    angle_error_rms_max_rad: NonNegative | None = None
    """Following error of the angle, rms."""
    angle_error_peak_max_rad: NonNegative | None = None
    """Largest following error of the angle."""
    angle_settling_max_s: NonNegative | None = None
    """From the end of the last move until the angle stays within 0.01 rad."""
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


class FaultsTable(Table):
    """What `hil faults` expects of this configuration: by row, in place of what the shipped matrix does."""

    expect: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """What must come of a row, by its name (keys: faults:row.expect)."""
