"""What is refused before a run: arming, references out of reach, filters, a drive that is not set up."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from drivers.busload import emulated_alone, message_rates, message_shares
from hil.config.tables import RunConfig
from hil.errors import ArmingError
from hil.log.recorder import BYTES_PER_TICK
from hil.runtime.bus import bus_settings, is_emulated_bus
from hil.runtime.progress import say
from hil.runtime.setup import Setup
from hil.tick.errorcodes import words

MAX_LOAD = 0.7
LOAD_REMEDY = f"keep it under {100 * MAX_LOAD:.0f} %: a lower loop.rate_hz, a higher bitrate, or CAN FD"


def check_arming(setup: Setup, arm: bool) -> None:
    """Refuse a real bus without an explicit ``--arm``; a shadow run sends nothing and needs none.

    Lockstep is refused there in any case: a real drive's time does not stand still.
    """
    bus, loop = setup.config.bus, setup.config.loop
    if is_emulated_bus(setup.config):
        return
    if loop.clock == "lockstep":
        raise ArmingError(
            f"{bus.interface}:{bus.channel} may carry a real drive, which keeps its own time: nothing was "
            'sent; leave --lockstep out, or set loop.clock = "realtime"'
        )
    if arm or loop.shadow:
        return
    raise ArmingError(
        f"{bus.interface}:{bus.channel} may carry a real drive: nothing was sent; "
        "check with 'hil check', then arm with --arm"
    )


def check_reachable(setup: Setup) -> None:
    """Say what can't be had; refuse it on a bus that may be real. Raises ArmingError."""
    if why := setup.binding.command.message.unwatched:
        say(f"warning: drive.signals.unwatched: {why}")
    for line in setup.warnings:
        say(f"warning: {line}")
    if setup.warnings and not (setup.config.loop.shadow or is_emulated_bus(setup.config)):
        raise ArmingError(f"{setup.warnings[0]}; nothing was sent")


def load_found(setup: Setup) -> tuple[str, bool]:
    """Worst-case bus load of this run in words, with the frames that make it, and whether it is allowed."""
    bus = setup.config.bus
    rates = message_rates(setup.binding, float(setup.config.loop.rate_hz), setup.config.feedback_every)
    shares = message_shares(rates, bus.bitrate, bus.data_bitrate)
    return load_words(shares, emulated_alone(setup.binding), bus.bitrate)


def load_words(shares: Mapping[str, float], emulated: Collection[str], bitrate: int) -> tuple[str, bool]:
    """The bus load in words, and whether it is allowed: of all but what an emulated drive alone sends."""
    own = {name: share for name, share in shares.items() if name not in emulated}
    load, more = sum(own.values()), sum(shares.get(name, 0.0) for name in emulated)
    frames = ", ".join(f"{name} {100 * share:.0f} %" for name, share in own.items())
    text = f"{100 * load:.0f} % at {bitrate} bit/s with every stuff bit, without other nodes: {frames}"
    if more:
        text += f"; {100 * more:.0f} % more by {', '.join(sorted(emulated))}, which no real drive sends"
    return text, load <= MAX_LOAD


def check_load(setup: Setup) -> None:
    """Refuse to overload a real bus; an emulated one has no bitrate. Raises ArmingError."""
    if setup.config.loop.shadow or is_emulated_bus(setup.config):
        return
    found, good = load_found(setup)
    if not good:
        raise ArmingError(f"bus load {found}; nothing was sent; {LOAD_REMEDY}")


def check_set_up(setup: Setup) -> None:
    """Refuse a CANopen drive that lost what hil configure has set; asks it by SDO. Raises ArmingError.

    A fault in which it stands is told; arming resets it.
    """
    config = setup.config
    if config.canopen is None or config.loop.shadow:
        return
    from hil.runtime.configure import looked_at

    found = looked_at(setup.path, config, bus_settings(config), config.drive.heartbeat_timeout_s)
    if found.fault is not None:
        error = words(found.fault)
        say(f"warning: the drive stands in fault, error {error}: arming resets it; see to its cause")
    if problems := found.problems:
        more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
        raise ArmingError(
            f"the drive is not as hil configure sets it: {problems[0]}{more}; set it: hil configure "
            f"{setup.path}; no SYNC and no command was sent"
        )


def needed_bytes(config: RunConfig) -> int:
    """Disk space that a run of the configured length may take, at least one minute's."""
    seconds = config.loop.duration_s or 60.0
    return round(seconds * config.loop.rate_hz * BYTES_PER_TICK) + (8 << 20)
