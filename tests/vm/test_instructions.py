"""The instruction gate: what a tick costs on SocketCAN, held to the budget in `budget.toml`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hil.log.reader import open_log
from hil.replay import replay_log
from hil.runtime.fused import PHASES
from hil.signals import RxFlag
from tests.vm.guest.instructions import BUSES, DRIVES
from tests.vm.instructions import apart, budget, excess, read, table_of, total_of

pytestmark = [pytest.mark.vm, pytest.mark.timeout(1800)]


@pytest.fixture(scope="module")
def counted(socketcan: Path) -> dict[str, Any]:
    left = socketcan / "instructions.json"
    if not left.is_file():
        pytest.fail(f"nothing was counted:\n{(socketcan / 'printed').read_text()}")
    return read(left)


def of_bus(counted: dict[str, Any], name: str) -> Any:
    if name not in counted["buses"]:
        pytest.skip(f"{name}: the host has no such interface")
    return counted["buses"][name]


@pytest.mark.parametrize("name", [*BUSES, *DRIVES])
def test_a_tick_is_within_its_budget(
    counted: dict[str, Any], name: str, figure: Callable[[str], None]
) -> None:
    bus = of_bus(counted, name)
    figure(f"{name}: instructions a tick\n{table_of(bus, budget()[name])}")
    assert not (over := excess(name, bus)), over


@pytest.mark.parametrize("name", [*BUSES, *DRIVES])
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
