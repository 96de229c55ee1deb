"""One row of the matrix as real processes: emulated drive, controller, its writer, on a bus of their own.

The processes are forked from one that has imported everything; what they run is what ``hil emulate`` and
``hil run`` run. Faults of the host are put on the running controller from outside.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import math
import multiprocessing
import os
import resource
import select
import signal
import socket
import struct
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final

from drivers.bus import open_link
from drivers.errors import DriverError
from drivers.mapping import COMMANDED_D, COMMANDED_Q
from firmware_model.node import BLACK_BOX
from hil.errors import ConfigError, HilError
from hil.faults.judge import Evidence, Result, judge, judge_together
from hil.faults.matrix import ClockStep, DiskFull, InterfaceDown, Matrix, Row, Stall, WriterKilled
from hil.log.reader import open_log
from hil.replay import replay
from hil.runtime.bus import bus_settings
from hil.runtime.nodesession import run_nodes
from hil.runtime.nodesetup import Nodes, load_node_setups
from hil.runtime.session import run
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import DriveState
from hil.sim.demo import set_up
from hil.sim.emulate import load_plants, serve

RUN_TIMEOUT_S: Final = 60.0
SAYS_NOTHING_S: Final = 20.0
STEPPED: Final = "the wall clock was stepped"
_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 1
_fork = multiprocessing.get_context("fork")


class Forked:
    """A function as a process; its standard output is a pipe of ours, its standard error a file."""

    def __init__(self, errors: Path, target: Callable[..., None], *args: Any) -> None:
        self.out, write = os.pipe()
        self._process: BaseProcess = _fork.Process(target=_redirected, args=(write, errors, target, args))
        self._process.start()
        os.close(write)
        self.pid = self._process.pid or 0

    def line(self) -> str:
        """Its next line; what there is of it when it ends or says nothing for a while."""
        text = b""
        while not text.endswith(b"\n") and select.select([self.out], [], [], SAYS_NOTHING_S)[0]:
            byte = os.read(self.out, 1)
            if not byte:
                break
            text += byte
        return text.decode().strip()

    def rest(self) -> str:
        """All that it still says until it ends."""
        parts = []
        while part := os.read(self.out, 1 << 16):
            parts.append(part)
        os.close(self.out)
        return b"".join(parts).decode()

    def wait(self, timeout_s: float) -> int | None:
        """Its exit code, None when it is still there."""
        self._process.join(timeout_s)
        return self._process.exitcode

    def end(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self._process.is_alive():
            os.kill(self.pid, number)


def _redirected(write: int, errors: Path, target: Callable[..., None], args: tuple[Any, ...]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    os.dup2(write, 1)
    with errors.open("wb") as file:
        os.dup2(file.fileno(), 2)
    sys.stdout, sys.stderr = (os.fdopen(os.dup(fd), "w", encoding="utf-8") for fd in (1, 2))
    target(*args)
    sys.stdout.flush()


def setups_of(path: Path, overrides: Overrides) -> Nodes:
    """Each node's set-up by its name; that of one drive alone by no name. Raises ConfigError."""
    return load_node_setups(path, overrides) or {"": load_setup(path, overrides)}


def _control(setups: Nodes, host: Any) -> None:
    """The controller's process."""
    stepped = _step_wall_clock(host) if isinstance(host, ClockStep) else lambda: False
    try:
        outcome = (run(setups[""]) if "" in setups else run_nodes(setups)).outcome
    except (HilError, DriverError) as error:
        os.write(2, f"{error}\n".encode())
        raise SystemExit(2) from error
    os.write(1, f"{outcome.reason}\n".encode())
    if stepped():
        os.write(1, f"{STEPPED}\n".encode())


def _step_wall_clock(fault: ClockStep) -> Callable[[], bool]:
    """Let the wall clock of this process jump once; nothing else of the machine sees it. True once it has."""
    begin, time_s, time_ns = time.monotonic(), time.time, time.time_ns

    def step_s() -> float:
        return fault.step_s if time.monotonic() - begin > fault.at_s else 0.0

    setattr(time, "time", lambda: time_s() + step_s())  # noqa: B010 - a module's function, on purpose
    setattr(time, "time_ns", lambda: time_ns() + round(step_s() * 1e9))  # noqa: B010
    return lambda: abs(time.time() - time_s() - fault.step_s) < 1.0 <= abs(fault.step_s)


def own_network() -> None:
    """Move this process into a network namespace of its own, with loopback up. Raises HilError."""
    libc = ctypes.CDLL(None, use_errno=True)
    uid, gid = os.getuid(), os.getgid()
    if libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET) != 0:
        raise HilError(f"no network namespace of its own: {os.strerror(ctypes.get_errno())}")
    with contextlib.suppress(OSError):
        Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
        Path("/proc/self/uid_map").write_text(f"0 {uid} 1", encoding="ascii")
        Path("/proc/self/gid_map").write_text(f"0 {gid} 1", encoding="ascii")
    set_loopback(True)


def set_loopback(up: bool) -> None:
    """Bring the loopback interface of this network namespace up or down."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        name = struct.pack("16sH14x", b"lo", 0)
        flags = struct.unpack_from("16sH", fcntl.ioctl(sock, _SIOCGIFFLAGS, name))[1]
        flags = flags | _IFF_UP if up else flags & ~_IFF_UP
        fcntl.ioctl(sock, _SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", flags))


@contextlib.contextmanager
def emulator(
    path: Path, overrides: Overrides, plant_settings: list[str], errors: Path
) -> Iterator[list[str]]:
    """The emulated drive; what it said in the end is in the list that is yielded, after the block."""
    said: list[str] = []
    process = Forked(errors, serve, path, overrides, plant_settings)
    try:
        if not (line := process.line()).startswith("emulator ready"):
            raise HilError(f"the emulator can't start: {line or errors.read_text(encoding='utf-8').strip()}")
        yield said
    finally:
        process.end(signal.SIGTERM)
        said += process.rest().splitlines()
        if process.wait(10.0) is None:
            process.end(signal.SIGKILL)
            process.wait(10.0)


def black_boxes(said: list[str], count: int) -> list[dict[str, Any]]:
    """Each drive's own record of what was at its motor."""
    found = [json.loads(line.removeprefix(BLACK_BOX)) for line in said if line.startswith(BLACK_BOX)]
    if len(found) != count:
        raise HilError(f"the emulator left {len(found)} black boxes of {count}")
    return found


def wait_for_operation(setup: Setup, timeout_s: float = 30.0) -> int:
    """Listen until the drive says that operation is enabled; monotonic time of that [ns]."""
    feedback = setup.database.message("FEEDBACK", "State")
    read = feedback.reader("State")
    link = open_link(bus_settings(setup.config))
    end = time.monotonic() + timeout_s
    try:
        while time.monotonic() < end:
            frame = link.receive(100_000_000)
            if frame is None or frame.can_id != feedback.can_id or len(frame.data) != feedback.length:
                continue
            if read(frame.data)[0] == DriveState.OPERATION_ENABLED:
                return time.monotonic_ns()
    finally:
        link.close()
    raise HilError("the drive was not enabled")


def writer_of(pid: int) -> int:
    """Process id of the writer that the controller ``pid`` started."""
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split():
        if b"hil.log.writer" in Path(f"/proc/{child}/cmdline").read_bytes():
            return int(child)
    raise HilError("the controller has no writer")


def is_stopped(pid: int) -> bool:
    """True while a process is stopped by a signal."""
    stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    return stat.rsplit(")", 1)[1].split()[0] == "T"


def inject(host: Any, controller: Forked, setup: Setup, log: Callable[[], Path]) -> tuple[int, bool]:
    """Put a fault on the running controller: its monotonic time [ns]; False when it was seen not to act."""
    at_ns = wait_for_operation(setup) + round(host.at_s * 1e9)
    time.sleep(max(0.0, (at_ns - time.monotonic_ns()) * 1e-9))
    onset_ns, acted = time.monotonic_ns(), True
    if isinstance(host, Stall):
        controller.end(signal.SIGSTOP)
        time.sleep(host.for_ms * 1e-3)
        acted = is_stopped(controller.pid)
        controller.end(signal.SIGCONT)
    elif isinstance(host, WriterKilled):
        os.kill(writer_of(controller.pid), signal.SIGKILL)
    elif isinstance(host, DiskFull):
        size = log().stat().st_size
        resource.prlimit(writer_of(controller.pid), resource.RLIMIT_FSIZE, (size, size))
    elif isinstance(host, InterfaceDown):
        set_loopback(False)
        if host.for_ms is not None:
            time.sleep(host.for_ms * 1e-3)
            set_loopback(True)
    return onset_ns, acted


def run_row(path: Path, matrix: Matrix, row: Row, folder: Path) -> Result:
    """Run one row and judge it. Never raises: what went wrong is in the row's ``why``."""
    result = Result(row.name, row.expect.text, clock="realtime" if row.realtime else "lockstep")
    try:
        if isinstance(row.host, InterfaceDown):
            own_network()
        _run(path, matrix, row, folder, result)
    except (HilError, DriverError, OSError) as error:
        result.why.append(str(error))
    return result


def _run(path: Path, matrix: Matrix, row: Row, folder: Path, result: Result) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    own = (
        f"bus.channel={json.dumps('faults-' + uuid.uuid4().hex[:12])}",
        f"log.folder={json.dumps(str(folder))}",
    )
    overrides = Overrides(settings=(*matrix.settings(row), *own, 'log.name="run"'))
    setups, onset_ns, acted = setups_of(path, overrides), None, True
    setup = next(iter(setups.values()))
    with emulator(path, overrides, matrix.plant_settings(row), folder / "emulator.txt") as said:
        for one in setups.values():
            if one.config.canopen is not None:
                set_up(path, one.config)
        controller = Forked(folder / "controller.txt", _control, setups, row.host)
        try:
            if row.host is not None:
                onset_ns, acted = inject(row.host, controller, setup, lambda: folder / "run.mcap")
            if controller.wait(RUN_TIMEOUT_S) is None:
                result.why.append(f"the controller did not end in {RUN_TIMEOUT_S:g} s")
        finally:
            controller.end(signal.SIGKILL)
            controller.wait(10.0)
        ended, _, more = controller.rest().strip().partition("\n")
    if isinstance(row.host, ClockStep):
        acted = more == STEPPED
    if not ended.isdecimal():
        result.why.append("the controller died: " + (folder / "controller.txt").read_text(encoding="utf-8"))
    log = open_log(folder / "run.mcap")
    result.path = str(log.path)
    onset_s = row.onset_s
    if onset_ns is not None and len(log.ticks):
        onset_s = (onset_ns - int(log.ticks["t_ns"][0])) * 1e-9
    reason = int(ended) if ended.isdecimal() else None
    judged = {}
    for (name, one), box in zip(setups.items(), black_boxes(said, len(setups)), strict=True):
        seen = open_log(log.path, node=name) if name else log
        evidence = Evidence(seen, box, reason, onset_s, row.host, acted, one.binding.map.poll != "")
        judged[name] = _judged(row, one, name, evidence)
    judge_together(result, judged, row.expect.node)
    verdict = replay(log.path)
    result.replay = verdict.verdict
    if verdict.verdict != "same":
        result.why.append(f"replay: {verdict.verdict} {verdict.why}".strip())


def _judged(row: Row, setup: Setup, name: str, evidence: Evidence) -> Result:
    """One node's part of a row."""
    result, command = Result(row.name, row.expect.text), setup.binding.command
    reader = command.message.reader(*(n for part, n in command.parts if part in (*COMMANDED_Q, *COMMANDED_D)))
    expect = row.expect.of(name) if name else row.expect
    if not setup.config.follows_speed:  # it follows no speed
        expect = expect.model_copy(update={"w_error_rad_s": math.inf})
    judge(result, expect, evidence, setup.config.command.most, reader, command.message.send_id)
    return result


def check_rows(path: Path, matrix: Matrix, rows: list[Row]) -> Nodes:
    """Load every row's configurations; raises ConfigError with all mistakes of all rows."""
    problems: list[str] = []
    setups: Nodes = {}
    for row in rows:
        try:
            setups = setups_of(path, Overrides(settings=matrix.settings(row)))
            problems += [f"row {row.name!r}: {problem}" for problem in _no_node(row, setups)]
            configs = {name: setup.config for name, setup in setups.items()}
            for name, (plant, _) in load_plants(path, configs, matrix.plant_settings(row)).items():
                for fault in plant.fault:
                    if message := getattr(fault, "message", ""):
                        setups[name].database.message(message)
        except (HilError, DriverError) as error:
            found = error.problems if isinstance(error, ConfigError) else [str(error)]
            problems += [f"row {row.name!r}: {problem}" for problem in found]
    if problems or not setups:
        raise ConfigError(str(path), problems)
    return setups


def _no_node(row: Row, setups: Nodes) -> list[str]:
    """What is wrong with the node that a row expects to stop."""
    node, known = row.expect.node, " and ".join(setups)
    if node is not None and node not in setups:
        return [f"expect.node: {node!r}: " + (f"there are {known}" if known else "the bus has one drive")]
    if node is None and row.expect.reaction == "stop" and known:
        return [f"expect.node: missing; which of {known} stops for that reason?"]
    return []
