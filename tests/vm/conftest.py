"""One boot for all scenarios: natively where the host has vcan, else in the bench machine."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import FIGURE
from tests.vm.machine import ROOT, MachineError, run_in_machine

REQUIRED = os.environ.get("HIL_REQUIRE_VM") == "1"


@pytest.fixture
def figure(record_property: Callable[[str, object], None]) -> Callable[[str], None]:
    """Takes a line that is shown at the end, also when all is well."""
    return lambda line: record_property(FIGURE, line)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """On the host's own SocketCAN they are in real time; in the bench machine time is virtual."""
    ours = [item for item in items if item.get_closest_marker("vm")]
    if ours and host_has_can():
        for item in ours:
            item.add_marker("alone")


def host_has_can() -> bool:
    """True when this kernel lets us make a vcan interface (or vcan0 is up already)."""
    if Path("/sys/class/net/vcan0").exists():
        return True
    made = subprocess.run(["ip", "link", "add", "vcan0", "type", "vcan"], capture_output=True, check=False)
    if made.returncode != 0:
        return False
    return (
        subprocess.run(["ip", "link", "set", "vcan0", "up"], capture_output=True, check=False).returncode == 0
    )


def run_natively(out: Path) -> str:
    environment = os.environ | {"OUT": str(out), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "tests/vm/guest/suite.py"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    return done.stdout + done.stderr


@pytest.fixture(scope="session")
def socketcan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with what every scenario left; made once."""
    if kept := os.environ.get("HIL_SOCKETCAN_RESULTS"):  # judge a folder of an earlier boot again
        return Path(kept)
    out = tmp_path_factory.mktemp("socketcan")
    try:
        if host_has_can():
            printed = run_natively(out)
        else:
            result = run_in_machine(["python", "tests/vm/guest/suite.py"], timeout_s=2400.0, out=out)
            printed = result.stdout + result.stderr
    except (MachineError, OSError) as error:
        if REQUIRED:
            pytest.fail(f"a SocketCAN bus is required here: {error}")
        pytest.skip(f"no SocketCAN on this host and no bench machine: {error}")
    (out / "printed").write_text(printed)
    print(printed)
    return out
