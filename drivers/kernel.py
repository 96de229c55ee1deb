"""What the kernel says about a CAN interface: state, bitrate, restart, queue, error counters.

Read through ``ip -json`` of iproute2 and not from python-can, whose ``state`` is always active on socketcan.
Judging the facts is left to the caller.
"""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from typing import Any

from drivers.errors import DriverError

TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True)
class InterfaceFacts:
    """One interface. What its driver does not tell is None (vcan has neither bitrate nor state)."""

    name: str
    kind: str
    up: bool
    mtu: int
    queue_length: int
    state: str | None = None
    bitrate: int | None = None
    data_bitrate: int | None = None
    restart_ms: int | None = None
    tx_errors: int | None = None
    rx_errors: int | None = None
    bus_off_count: int | None = None
    warning_count: int | None = None
    passive_count: int | None = None
    restart_count: int | None = None
    bus_errors: int | None = None
    tx_dropped: int = 0
    tx_frames: int = 0
    rx_frames: int = 0

    def text(self) -> str:
        """The facts in one line; what the driver does not tell is left out."""
        known = (
            ("state", self.state),
            ("error counter tx", self.tx_errors),
            ("rx", self.rx_errors),
            ("times error-warning", self.warning_count),
            ("error-passive", self.passive_count),
            ("bus-off", self.bus_off_count),
            ("restarted", self.restart_count),
            ("bus errors", self.bus_errors),
            ("bitrate", self.bitrate),
            ("data bitrate", self.data_bitrate),
            ("restart-ms", self.restart_ms),
            ("queue length", self.queue_length),
            ("frames sent", self.tx_frames),
            ("dropped", self.tx_dropped),
            ("received", self.rx_frames),
        )
        told = ", ".join(f"{name} {value}" for name, value in known if value is not None)
        return f"{self.name} {self.kind} {'up' if self.up else 'down'}: {told}"


def interface_facts(name: str) -> InterfaceFacts | None:
    """Facts of an interface, None when there is none of that name. Raises DriverError without iproute2."""
    command = ["ip", "-json", "-details", "-statistics", "link", "show", "dev", name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise DriverError(f"can't ask the kernel about {name}: {error}; install iproute2") from error
    return parse_link(done.stdout, name) if done.returncode == 0 else None


def parse_link(text: str, name: str) -> InterfaceFacts | None:
    """Facts of ``name`` out of the JSON of ``ip``. Raises DriverError for what is not that JSON."""
    try:
        links: list[Any] = json.loads(text or "[]")
        found = [link for link in links if link.get("ifname") == name]
        return _facts(found[0]) if found else None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DriverError(f"can't read what ip says about {name}: {error!r}; update iproute2") from error


def _facts(link: dict[str, Any]) -> InterfaceFacts:
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    errors = data.get("berr_counter", {})
    counts, traffic = info.get("info_xstats", {}), link.get("stats64", {})
    controller = info.get("info_kind") == "can"
    return InterfaceFacts(
        name=link["ifname"],
        kind=info.get("info_kind", ""),
        up="UP" in link["flags"],
        mtu=link["mtu"],
        queue_length=link.get("txqlen", 0),
        state=data.get("state"),
        bitrate=data.get("bittiming", {}).get("bitrate", data.get("bittiming_bitrate")),
        data_bitrate=data.get("data_bittiming", {}).get("bitrate", data.get("data_bittiming_bitrate")),
        # the key is left out by some versions of ip when it is 0
        restart_ms=data.get("restart_ms", 0) if controller else None,
        tx_errors=errors.get("tx"),
        rx_errors=errors.get("rx"),
        bus_off_count=counts.get("bus_off"),
        warning_count=counts.get("error_warning"),
        passive_count=counts.get("error_passive"),
        restart_count=counts.get("restarts"),
        bus_errors=counts.get("bus_error"),
        tx_dropped=traffic.get("tx", {}).get("dropped", 0),
        tx_frames=traffic.get("tx", {}).get("packets", 0),
        rx_frames=traffic.get("rx", {}).get("packets", 0),
    )
