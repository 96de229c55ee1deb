"""Nothing reaches a drive around the guard: who may send at all, and what the client can send."""

from __future__ import annotations

import ast
import random
from pathlib import Path
from typing import Any

import pytest

from drivers.client import DriveClient
from drivers.codec import Database
from drivers.errors import EncodeError
from hil.signals import new_ticks
from tests.conftest import CONFIGS, ROOT

pytestmark = pytest.mark.slow

# (file, function): every place outside the links themselves that hands a frame to a link
MAY_SEND = {
    ("drivers/client.py", "_transmit"),  # what `send` and `stop` lay out from a guarded tick, and SYNC
    ("drivers/port.py", "_send"),  # passes on what the kernels send on a bus that is no descriptor
    ("drivers/rawlink.py", "send_raw"),  # passes on what the client sends
    ("drivers/lockstep.py", "send"),  # passes on what the client sends
    ("drivers/hub.py", "send"),  # passes on what the clients of two nodes send
    ("drivers/sdo.py", "send_message"),  # hil configure, and reads before arming: SDO alone
    ("drivers/canopen_node.py", "pre_operational"),  # hil configure: takes a node out of operation
    ("hil/runtime/bus.py", "sending_bus"),  # hil play: recorded frames, onto emulated buses unless allowed
}
LINKS = {"drivers/bus.py", "drivers/local.py"}
NO_CONTROLLER = {"drivers/bare.py"}  # the benchmark's loop without control: refuses what may be a real bus
# who may ask a drive port to send: the loop, with the tick that the guard has judged, and its wrapper
MAY_ASK = {("hil/runtime/loop.py", "answer"), ("hil/runtime/guardian.py", "send")}


def sends(path: Path, owner: str) -> set[tuple[str, str]]:
    """(file, function) of each use of ``send``/``send_raw`` of something whose name contains ``owner``."""
    name, found = str(path.relative_to(ROOT)), set()
    for function in ast.walk(ast.parse(path.read_text())):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for node in ast.walk(function):
            sending = isinstance(node, ast.Attribute) and node.attr in ("send", "send_raw")
            if sending and owner in ast.unparse(node.value).lower():
                found.add((name, function.name))
    return found


def all_sends(owner: str) -> set[tuple[str, str]]:
    files = [*(ROOT / "hil").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")]
    own = [path for path in files if str(path.relative_to(ROOT)) not in LINKS | NO_CONTROLLER]
    return set().union(*(sends(path, owner) for path in own))


def test_only_the_client_hands_frames_to_a_link() -> None:
    assert all_sends("link") == MAY_SEND


def test_only_the_loop_asks_the_drive_to_send() -> None:
    assert all_sends("drive") == MAY_ASK


def test_only_the_client_and_the_compiled_ticks_call_the_kernels_that_send() -> None:
    """These send what the guard has judged in the same call: tests/contract/test_fused*.py."""
    callers = set()
    for path in [*(ROOT / "hil").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "drivers.posix":
                sending = {"begin", "command", "exchange", "opened", "transmit", "write"} & {
                    alias.name for alias in node.names
                }
                callers |= {str(path.relative_to(ROOT))} if sending else set()
    ticks = {"hil/runtime/fused.py", "hil/runtime/fusednodes.py"}
    assert callers == {"drivers/client.py"} | ticks


class Wire:
    """A link that keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, int]] = []

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        self.sent.append((can_id, len(data)))

    def receive(self, timeout_ns: int) -> None:
        return None

    def discard(self) -> int:
        return 0

    def close(self) -> None: ...


@pytest.mark.parametrize(
    ("load", "allowed"),
    [(False, {(0x080, 1), (0x201, 8)}), (True, {(0x080, 1), (0x201, 8), (0x301, 4)})],
)
def test_the_client_sends_its_own_identifiers_and_lengths_alone(
    load: bool, allowed: set[tuple[int, int]]
) -> None:
    dice, wire, tick = random.Random(20261124), Wire(), new_ticks()[0]
    client = DriveClient(wire, Database(CONFIGS / "drives" / "hil_pmsm.dbc"), load=load)
    refused = 0
    for _ in range(500):
        fields: dict[str, Any] = {
            "counter": dice.randrange(256),
            "controlword": dice.randrange(1 << 16),
            "u_q": dice.choice([dice.uniform(-400, 400), float("nan"), float("inf")]),
            "u_d": dice.uniform(-400, 400),
            "T_L": dice.uniform(-400, 400),
        }
        for name, value in fields.items():
            tick[name] = value
        before = len(wire.sent)
        try:
            client.send(tick)
        except EncodeError:
            refused += 1
            assert len(wire.sent) == before  # whole or not at all
        client.sync(tick)
    client.stop()
    assert set(wire.sent) == allowed and 100 < refused < 500
