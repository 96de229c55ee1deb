"""Worst-case load of a CAN bus by its messages: bits of a frame with all stuff bits, times its rate."""

from __future__ import annotations

from collections.abc import Iterable

from drivers.binding import Binding
from drivers.codec import Message
from drivers.mapping import MEASURED

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


def classic_bits(length: int, extended: bool = False) -> int:
    """Longest classic frame of ``length`` data bytes, with the interframe space [bit].

    C = g + 8 s + 13 + floor((g + 8 s - 1) / 4), g = 34 (11-bit identifier) or 54 (29-bit): Davis, Burns,
    Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and revised",
    Real-Time Systems 35 (2007), section 2.
    """
    exposed = (54 if extended else 34) + 8 * length
    return exposed + 13 + (exposed - 1) // 4


def fd_bits(length: int, extended: bool = False) -> tuple[int, int]:
    """Longest CAN FD frame of up to ``length`` bytes: (bits at the nominal, bits at the data bitrate).

    Nominal 32 (11-bit identifier) or 49 (29-bit), data 28 + 5 ceil((s - 16) / 64) + 10 s: Bordoloi, Samii,
    "The frame packing problem for CAN-FD", IEEE RTSS 2014.
    """
    s = next(size for size in FD_LENGTHS if size >= length)
    return (49 if extended else 32), 28 + 5 * max(0, -(-(s - 16) // 64)) + 10 * s


def frame_seconds(
    length: int, *, fd: bool, extended: bool, bitrate: int, data_bitrate: int | None = None
) -> float:
    """Longest time that one frame occupies the bus [s]."""
    if not fd:
        return classic_bits(length, extended) / bitrate
    nominal, data = fd_bits(length, extended)
    return nominal / bitrate + data / (data_bitrate or bitrate)


def bus_load(frames: Iterable[tuple[float, float]]) -> float:
    """Share of the bus's time that (seconds per frame, frames per second) take together, 0 .. 1 and over."""
    return sum(seconds * rate for seconds, rate in frames)


def message_rates(binding: Binding, rate_hz: float, every: int = 1) -> list[tuple[Message, float]]:
    """How often each message of the map is on the bus [1/s], the loop running at ``rate_hz``.

    SYNC and commands once a tick, but for those sent on change alone, which are not counted; measurements in
    each ``every``-th; others by the DBC's cycle time, which for a drive that takes SYNC counts in SYNCs;
    heartbeats by their cycle time alone. Without: not counted.
    """
    sync, beat = binding.sync, binding.heartbeat
    stretch = rate_hz * sync.cycle_ms / 1000.0 if sync and sync.cycle_ms else 1.0
    seldom = binding.map.on_change
    rates = [(bound.message, rate_hz) for bound in binding.outgoing if bound.message.name not in seldom]
    rates += [(sync, rate_hz)] if sync else []
    for bound in binding.incoming:
        if any(part in MEASURED for part, _ in bound.parts):
            rates.append((bound.message, rate_hz / every))
        elif bound.message.cycle_ms:
            rates.append((bound.message, 1000.0 / bound.message.cycle_ms * stretch))
    return rates + ([(beat, 1000.0 / beat.cycle_ms)] if beat and beat.cycle_ms else [])


def emulated_alone(binding: Binding) -> set[str]:
    """Messages that carry nothing but what only an emulated drive knows."""
    return {b.message.name for b in binding.incoming if {part for part, _ in b.parts} == {"load_true"}}


def message_shares(
    rates: Iterable[tuple[Message, float]], bitrate: int, data_bitrate: int | None = None
) -> dict[str, float]:
    """Worst-case share of the bus's time that each message takes, by name, the largest first."""
    shares = {
        m.name: rate
        * frame_seconds(m.length, fd=m.fd, extended=m.extended, bitrate=bitrate, data_bitrate=data_bitrate)
        for m, rate in rates
    }
    return dict(sorted(shares.items(), key=lambda pair: -pair[1]))
