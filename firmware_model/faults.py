"""Fault scripts of the emulated drive: when, for how long, what. Tables only; what they do is left to
:mod:`firmware_model.faulty_plant` (the drive itself) and :mod:`firmware_model.faulty_link` (its bus side).

Times are plant time [s] from the first SYNC; ``for_s`` left out means for good. Every random choice is
drawn from the fault's own ``seed``, so that a script gives the same run each time.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field

from firmware_model.tables import Finite, NonNegative, Positive, Since, Span, Table


class FaultTable(Table):
    """What all faults have: a beginning and a length."""

    at_s: Since
    """When it begins [plant time]."""
    for_s: Span | None = None
    """How long it lasts; left out: for good."""
    node: str | None = None
    """Of several nodes the one that it happens to; left out: each whose plant has it."""

    def active(self, t_ns: int) -> bool:
        """True while the fault is there; both ends are exact nanoseconds."""
        begin = round(self.at_s * 1e9)
        return begin <= t_ns and (self.for_s is None or t_ns < begin + round(self.for_s * 1e9))


class FrameFault(FaultTable):
    """Something happens to a share of the frames of one message, in the direction in which it travels."""

    message: str = "FEEDBACK"
    """Name of the message in the DBC."""
    share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of its frames that are hit."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1
    """Seed of the draw which ones."""


class Drop(FrameFault):
    """The frame is lost."""

    kind: Literal["drop"]


class Delay(FrameFault):
    """The frame comes later."""

    kind: Literal["delay"]
    delay_ms: Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]
    """By how much later."""


class Duplicate(FrameFault):
    """The frame comes twice."""

    kind: Literal["duplicate"]


class Reorder(FrameFault):
    """The frame comes after the next one of its message."""

    kind: Literal["reorder"]


class Corrupt(FrameFault):
    """``bits`` different bits of the frame are flipped."""

    kind: Literal["corrupt"]
    bits: Annotated[int, Field(ge=1, le=32)] = 1
    """How many bits are flipped."""


class FrozenCounter(FrameFault):
    """The frame's counter stands still; CRC and values stay good."""

    kind: Literal["frozen-counter"]


class BusOff(FaultTable):
    """The controllers fall off the bus: an error frame says so, then nothing passes in either direction.

    On a bus of several nodes it is the node's own controller alone: silent and deaf, which nobody says.
    """

    kind: Literal["bus-off"]


class FrozenValue(FaultTable):
    """Speed and currents stand still in frames whose counter and CRC are good."""

    kind: Literal["frozen-value"]


class Noise(FaultTable):
    """Sensors with this standard deviation instead of their own."""

    kind: Literal["noise"]
    w_noise_rad_s: NonNegative = 0.0
    """Noise of the measured speed, standard deviation."""
    i_noise_a: NonNegative = 0.0
    """Noise of the measured currents, standard deviation."""


class Bias(FaultTable):
    """Sensors that read too much by this."""

    kind: Literal["bias"]
    w_rad_s: Finite = 0.0
    """Added to the measured speed."""
    i_q_a: Finite = 0.0
    """Added to the measured i_q."""
    i_d_a: Finite = 0.0
    """Added to the measured i_d."""


class EncoderSlip(FaultTable):
    """The rotor angle that the drive transforms by is off by this electrical angle."""

    kind: Literal["encoder-slip"]
    angle_deg: Finite
    """Electrical angle by which the rotor angle is off."""


class EncoderReversed(FaultTable):
    """The encoder counts the wrong way: speed and rotor angle come with the other sign."""

    kind: Literal["encoder-reversed"]


class PhaseSwap(FaultTable):
    """Phases b and c are exchanged between drive and motor."""

    kind: Literal["phase-swap"]


TURNING: Final = (EncoderSlip, EncoderReversed, PhaseSwap)
"""Faults that turn a commanded voltage."""


class PhaseLoss(FaultTable):
    """Phase a is open: no current flows in the stator's alpha axis."""

    kind: Literal["phase-loss"]


class DcLink(FaultTable):
    """The DC link stands at another voltage."""

    kind: Literal["dc-link"]
    v_dc_v: Positive
    """Where the DC link stands."""


class OverTemperature(FaultTable):
    """The motor's winding heats up at this rate on top of its losses."""

    kind: Literal["over-temperature"]
    rate_k_s: Positive
    """Rise a second."""


class ExtraLoad(FaultTable):
    """A load torque on top of the plant's loads."""

    kind: Literal["load"]
    torque_n_m: Finite
    """Torque, positive against positive speed."""


class BrownOut(FaultTable):
    """The drive's supply fails: silent, gates off; when it comes back the firmware boots anew."""

    kind: Literal["brown-out"]
    for_s: Span
    """How long the supply is away."""


LinkFault = Drop | Delay | Duplicate | Reorder | Corrupt | FrozenCounter | BusOff
PlantFault = (
    FrozenValue
    | Noise
    | Bias
    | EncoderSlip
    | EncoderReversed
    | PhaseSwap
    | PhaseLoss
    | DcLink
    | OverTemperature
    | ExtraLoad
    | BrownOut
)
Fault = Annotated[LinkFault | PlantFault, Field(discriminator="kind")]
