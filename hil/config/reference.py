"""Tables of the speed reference w*, of moves, of the way to rest, and of set-points at run time."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hil.config.table import LEAST, Finite, NonNegative, Positive, Since, Speed, Table


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


class MoveReference(Table):
    """A move from rest to rest by ``target_turns`` or ``target_rad`` from where the shaft is armed.

    The speed reaches ``w_rad_s``, or less where the way is too short for it. The law position ends at the
    target; of others it is the speed alone.
    """

    kind: Literal["move"]
    target_rad: Finite | None = None
    """Where it goes, from where it was armed; 0 holds that angle."""
    target_turns: Annotated[float, Field(ge=-1e8, le=1e8, allow_inf_nan=False)] | None = None
    """The same in turns."""
    w_rad_s: Annotated[float, Field(ge=LEAST, le=1e6, allow_inf_nan=False)]
    """Largest speed on the way."""
    rate_rad_s2: Positive
    """Largest slope."""
    jerk_rad_s3: Positive | None = None
    """Slope of the slope; left out: not limited."""
    at_s: Since = 0.0
    """When it begins."""

    @model_validator(mode="after")
    def _one_target(self) -> MoveReference:
        if (self.target_rad is None) == (self.target_turns is None):
            raise ValueError("give the target once, as target_rad or as target_turns")
        return self

    @property
    def way(self) -> float:
        """The target [rad]."""
        return 2.0 * math.pi * self.target_turns if self.target_turns is not None else self.target_rad or 0.0


ReferenceTable = Annotated[
    StepReference | RampReference | SCurveReference | SineReference | TableReference | MoveReference,
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
