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
        bus_off_count=info.get("info_xstats", {}).get("bus_off"),
    )
