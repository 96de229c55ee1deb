"""The instruction gate: what a tick costs on SocketCAN, held to the budget in `budget.toml`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hil.log.reader import open_log
from hil.replay import replay_log
from hil.runtime.fused import PHASES
from hil.signals import DriveState, RxFlag
from tests.vm.guest.instructions import BUSES, DRIVES, NODES
from tests.vm.instructions import LEFT, apart, budget, excess, read, table_of, total_of

pytestmark = [pytest.mark.vm, pytest.mark.timeout(1800)]


@pytest.fixture(scope="module")
def counted(socketcan: Path) -> dict[str, Any]:
    if not all((socketcan / name).is_file() for name in LEFT):
        pytest.fail(f"not all was counted:\n{(socketcan / 'printed').read_text()}")
    return read(socketcan)


def of_bus(counted: dict[str, Any], name: str) -> Any:
    if name not in counted["buses"]:
        pytest.skip(f"{name}: the host has no such interface")
    return counted["buses"][name]


@pytest.mark.parametrize("name", [*BUSES, *DRIVES, *NODES])
def test_a_tick_is_within_its_budget(
    counted: dict[str, Any], name: str, figure: Callable[[str], None]
) -> None:
    bus = of_bus(counted, name)
    figure(f"{name}: instructions a tick\n{table_of(bus, budget()[name])}")
    assert not (over := excess(name, bus)), over


@pytest.mark.parametrize("name", [*BUSES, *DRIVES, *NODES])
def test_two_runs_of_a_boot_cost_the_same(counted: dict[str, Any], name: str) -> None:
    """What makes the budget's 3 percent a bound and not noise."""
    bus = of_bus(counted, name)
    assert apart(bus) < 0.02 * total_of(bus), bus["runs"]


@pytest.mark.parametrize("name", BUSES)
def test_every_phase_was_seen_and_they_add_up(counted: dict[str, Any], name: str) -> None:
    """The meter takes some thousand instructions a tick, taken off but for caches and rounding."""
    bus = of_bus(counted, name)
    assert set(bus["phases"]) == set(PHASES)
    sleeps = set() if name == "kernel" else {"sleep"}  # there the loop waits for feedback alone
    assert {phase for phase, count in bus["phases"].items() if count > 0} == set(PHASES) - {"sleep"} | sleeps
    assert sum(bus["phases"].values()) == pytest.approx(total_of(bus), rel=0.2), bus


@pytest.mark.parametrize("name", DRIVES)
def test_a_shipped_drive_is_kept_up_with(counted: dict[str, Any], socketcan: Path, name: str) -> None:
    """No period is skipped, the log replays to the bit, and a tick stays under 50,000.

    The drive answers in time: a tick without feedback has nothing to decode, and would cost a quarter less.
    """
    bus = of_bus(counted, name)
    said = bus["said"]
    assert (said["skipped"], said["dropped"], said["ended"]) == (0, 0, "stop_requested"), said
    log = open_log(socketcan / f"{name}.mcap")
    assert len(log.ticks) >= 500 and replay_log(log).verdict == "same"
    assert ((log.ticks["rx_flags"] & int(RxFlag.FRESH)) != 0).mean() > 0.99
    assert total_of(bus) < 50_000


@pytest.mark.parametrize("name", NODES)
def test_each_node_of_those_that_are_counted_answers_in_time(
    counted: dict[str, Any], socketcan: Path, name: str
) -> None:
    """Else a tick would have less to decode. No period is skipped, and the log replays to the bit."""
    said = of_bus(counted, name)["said"]
    assert (said["skipped"], said["dropped"], said["ended"]) == (0, 0, "stop_requested"), said
    path = socketcan / f"{name}.mcap"
    logs = [open_log(path, node=one) for one in ("motor", "load")] if name == "nodes" else [open_log(path)]
    for log in logs:
        fresh = (log.ticks["rx_flags"] & int(RxFlag.FRESH)) != 0
        assert len(log.ticks) >= 500 and fresh.mean() > 0.99
        assert (log.ticks["state"] == int(DriveState.OPERATION_ENABLED)).mean() > 0.9
        assert replay_log(log).verdict == "same"


def test_two_nodes_cost_less_than_half_more_than_one(counted: dict[str, Any]) -> None:
    """Of the same drive in the same boot: 1.47 x."""
    assert total_of(of_bus(counted, "nodes")) < 1.5 * total_of(of_bus(counted, "node"))
