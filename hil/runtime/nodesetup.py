"""Two nodes on one bus before anything opens: each a set-up of its own, and what they must have in common."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from drivers.busload import emulated_alone, message_rates, message_shares
from drivers.hub import heard_ids
from hil.config.design import inner_loop
from hil.config.nodefile import load_nodes
from hil.errors import ArmingError, ConfigError
from hil.runtime.bus import is_emulated_bus
from hil.runtime.refusals import LOAD_REMEDY, load_words
from hil.runtime.setup import Overrides, Setup, setup_of

Nodes = Mapping[str, Setup]
"""Each node's set-up by its name, in the configuration's order."""


def load_node_setups(path: Path, overrides: Overrides) -> Nodes | None:
    """All nodes of a configuration with several, checked; None for one of one drive. Raises ConfigError."""
    configs = load_nodes(path, overrides.as_settings())
    if configs is None:
        return None
    setups = {}
    for name, config in configs.items():
        try:
            setups[name] = setup_of(path, config)
        except ConfigError as error:
            raise ConfigError(f"{path}: node {name}", error.problems) from error
    if problems := [*_unfit(setups), *_same(setups), *_pair(setups)]:
        raise ConfigError(str(path), problems)
    return setups


def _unfit(setups: Nodes) -> list[str]:
    """What a node of several can't have."""
    first = next(iter(setups.values())).config
    rules = {
        'loop.pacing: several nodes answer one SYNC; take "sync"': first.loop.pacing != "sync",
        "loop.shadow: not with several nodes; take one: --set node=NAME": first.loop.shadow,
        'bus.sync: not by the kernel with several nodes; take "loop"': first.bus.sync != "loop",
        "log.split_s, log.split_mb: a log of several nodes is one file; remove them": (
            first.log.split_s is not None or first.log.split_mb is not None
        ),
    }
    problems = [text for text, wrong in rules.items() if wrong]
    for name, setup in setups.items():
        if setup.config.drive.kind != "dbc":
            problems.append(f'{name}: drive.kind = "{setup.config.drive.kind}": several nodes take "dbc"')
        elif setup.binding.sync is None:
            problems.append(f"{name}: drive.signals.sync: missing; several nodes answer one SYNC")
        if setup.config.feedback_every > 1:
            problems.append(f"{name}: feedback.period_ms: several nodes measure in each tick; remove it")
    return problems


def _same(setups: Nodes) -> list[str]:
    """What must be the same of both, and what must not."""
    (one, a), (other, b) = setups.items()
    problems = []
    syncs = [setup.binding.sync for setup in (a, b)]
    if syncs[0] and syncs[1] and (syncs[0].send_id, syncs[0].length) != (syncs[1].send_id, syncs[1].length):
        problems.append(f"drive.signals.sync: {one} and {other} take another SYNC; one SYNC is for both")
    shared = sorted(heard_ids(a.binding) & heard_ids(b.binding))
    if shared:
        names = {m.send_id: m.name for m in (bound.message for bound in a.binding.incoming)}
        names |= {bound.message.send_id: bound.message.name for bound in a.binding.outgoing}
        frames = ", ".join(
            f"0x{can_id:X}" + (f" {names[can_id]}" if can_id in names else "") for can_id in shared
        )
        problems.append(
            f"drive.node_id: {one} ({a.config.drive.node_id}) and {other} ({b.config.drive.node_id}) have "
            f"the same frames ({frames}); give each node its own number"
        )
    return problems


def _pair(setups: Nodes) -> list[str]:
    """What one law over both nodes needs of them: fac on the drive under test, follow on the load machine."""
    kinds = {name: setup.config.controller.kind for name, setup in setups.items() if setup.config.paired}
    if not kinds:
        return []
    if sorted(kinds.values()) != ["fac", "follow"]:
        return [
            f"controller.kind: {' and '.join(f'{name} {kind}' for name, kind in kinds.items())}; one law "
            "over both is fac on the drive under test and follow on the load machine"
        ]
    (test,) = (one for one in setups.values() if one.config.controller.kind == "fac")
    name, load = next((name, one) for name, one in setups.items() if one is not test)
    config, most = test.config, test.config.limits.T_L_max_n_m
    problems = []
    for key in ("current_lag_ms", "delay_ticks"):
        ours, theirs = (getattr(one.config.drive, key) for one in (test, load))
        if ours != theirs:
            problems.append(
                f"drive.{key}: {ours:g} and {theirs:g}; the law fac moves both drives as one: give both the "
                "slower one's, or set the faster one's current loop to it"
            )
    if "i_q" not in load.wire.measured:
        problems.append(
            f"{name}: reports neither i_q nor torque, which fac is told; map one in drive.signals"
        )
    inner = inner_loop(load.config)
    assert inner is not None  # noqa: S101 - of a law that takes no voltages
    reach = min(load.config.k_t * load.config.limits.i_max_a, inner.k_u * load.config.command.most)
    if not 0.0 < most <= reach * (1 + 1e-9):
        problems.append(
            f"limits.T_L_max_n_m = {most:g} of the law fac: must be positive and within what the limits of "
            f"{name} allow, {reach:.4g} N m"
        )
    if config.motor.J_kg_m2 != load.config.motor.J_kg_m2:
        problems.append(
            f"motor.J_kg_m2: {config.motor.J_kg_m2:g} and {load.config.motor.J_kg_m2:g}; both are on one "
            "shaft, and each torque accelerates the whole of it: give both its inertia"
        )
    return problems


def nodes_load(setups: Nodes) -> tuple[str, bool]:
    """Worst-case bus load of all nodes in words, SYNC once, and whether it is allowed."""
    shares: dict[str, float] = {}
    emulated: set[str] = set()
    for index, (name, setup) in enumerate(setups.items()):
        bus, sync = setup.config.bus, setup.binding.sync
        rates = message_rates(setup.binding, float(setup.config.loop.rate_hz))
        rates = [(message, rate) for message, rate in rates if not (index and message is sync)]
        own = message_shares(rates, bus.bitrate, bus.data_bitrate)
        shares |= {f"{name} {message}": share for message, share in own.items()}
        emulated |= {f"{name} {message}" for message in emulated_alone(setup.binding)}
    return load_words(shares, emulated, bus.bitrate)


def check_nodes_load(setups: Nodes) -> None:
    """Refuse to overload a real bus. Raises ArmingError."""
    found, good = nodes_load(setups)
    if not good and not is_emulated_bus(next(iter(setups.values())).config):
        raise ArmingError(f"bus load {found}; nothing was sent; {LOAD_REMEDY}")
