"""Other users of the machine: nothing that a run and its viewers make is theirs to read, write or reach.

Everything is started with umask 0, so that whatever is closed was closed by the program. What is written for
people to read (reports, exports) follows the umask.
"""

from __future__ import annotations

import os
import re
import signal
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path

import pytest

from tests.process.test_run import flags, only_log
from tests.process.test_watch import wait_for_run

pytestmark = [pytest.mark.process, pytest.mark.slow]
Settings = Callable[..., tuple[str, ...]]
OTHERS = 0o077
BUSES = IPv4Network("239.192.0.0/14")
"""Multicast groups of ``hil-local``: joined on loopback alone, sent with TTL 0."""
CLAIM = re.compile("@hil-drive/[0-9a-f]{64}")
"""A name in the kernel that a process holds and never accepts at: see hil/runtime/claim.py."""
LISTENS = "0A"
NO_SUCH_USER = 65534


@dataclass
class Bench:
    """A run with its emulator and its viewers, and where their files go."""

    folder: Path
    environment: dict[str, str]
    stack: ExitStack
    processes: dict[str, subprocess.Popen[str]] = field(default_factory=dict)

    def start(self, *words: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "hil.cli", *words], env=self.environment, umask=0, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        self.processes[words[0]] = process
        self.stack.callback(self.end, process)
        return process

    def end(self, process: subprocess.Popen[str]) -> str:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        return process.communicate(timeout=60)[0]

    def call(self, *words: str) -> None:
        process = self.start(*words)
        said, _ = process.communicate(timeout=120)
        assert process.returncode == 0, said

    def family(self) -> list[int]:
        """Every process that was started here, and their children."""
        parents = {int(p.name): parent_of(p) for p in Path("/proc").glob("[0-9]*")}
        found = [process.pid for process in self.processes.values() if process.poll() is None]
        for pid in found:
            found += [child for child, parent in parents.items() if parent == pid]
        return found

    def files(self) -> list[Path]:
        """What is in the folders that they write into, these folders themselves left out."""
        places = [self.folder / name for name in ("tmp", "made")]
        return [path for place in places for path in place.rglob("*")]


def parent_of(process: Path) -> int:
    try:
        return int(process.joinpath("stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def until(process: subprocess.Popen[str], word: str) -> str:
    """Read what a process says up to a line with the word."""
    assert process.stdout is not None
    for line in process.stdout:
        if word in line:
            return line
    raise AssertionError(f"it never said {word!r}")


@pytest.fixture
def bench(
    configs: Path, settings: Settings, channel: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Bench]:
    """A run in operation, listed in the temporary folder, as on a machine without a runtime folder."""
    for name in ("tmp", "made"):
        (tmp_path / name).mkdir()
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr("tempfile.tempdir", None)
    log = f'log.folder="{tmp_path / "made" / "deep" / "logs"}"'
    own = flags(settings("loop.duration_s=90.0", log))
    with ExitStack() as stack:
        made = Bench(tmp_path, dict(os.environ), stack)
        until(made.start("emulate", str(configs / "demo.toml"), *own), "ready")
        run = made.start("run", str(configs / "demo.toml"), *own)
        wait_for_run(run, channel)
        yield made


@pytest.mark.long
def test_files_and_shared_memory_are_the_users_alone(bench: Bench) -> None:
    web = bench.start("watch", "--web", "--port", "0")
    until(web, "http://")
    pids = bench.family()
    assert len(pids) == 5, "emulator, controller, guardian, writer, viewer"
    rings = [link for link, what in opened_by(pids) if what.startswith("/memfd:hil-")]
    assert len(rings) >= 6 and all(link.stat().st_mode & OTHERS == 0 for link in rings)
    running = set(bench.files())
    assert {path.name for path in running} >= {f"{bench.processes['run'].pid}.json"}
    assert_closed(running)
    bench.end(bench.processes["run"])
    bench.end(web)
    log = only_log(bench.folder / "made" / "deep")
    shared = bench.folder / "shared"
    shared.mkdir()
    for name in ("ticks.csv", "ticks.mat", "frames.log", "report.html", "report.png"):
        command = "report" if "report" in name else "export"
        bench.call(command, str(log), "-o", str(shared / name))
    assert [oct(p.stat().st_mode & 0o777) for p in shared.iterdir()] == ["0o666"] * 5
    bench.call("recover", str(log), "-o", str(bench.folder / "made" / "again.mcap"))
    config = bench.folder / "configs" / "demo.toml"
    words = ("replay", str(log), "--config", str(config), "-o", str(bench.folder / "made" / "other.mcap"))
    bench.call(*words)
    bench.call("import", str(shared / "frames.log"), "-o", str(bench.folder / "made" / "back.mcap"),
               "--config", str(config))  # fmt: skip
    after = set(bench.files())
    assert {path.name for path in after} >= {log.name, "again.mcap", "other.mcap", "back.mcap"}
    assert_closed(after)


def assert_closed(paths: set[Path]) -> None:
    """Only the folder above the log's own is as the umask has it."""
    above = {path.parent.parent for path in paths if path.parent.name == "logs"}
    open_ones = {str(p): oct(p.lstat().st_mode) for p in paths - above if p.lstat().st_mode & OTHERS}
    assert open_ones == {}


def opened_by(pids: list[int]) -> list[tuple[Path, str]]:
    """Every descriptor of the processes, and what it leads to."""
    return [(link, str(link.readlink())) for pid in pids for link in Path(f"/proc/{pid}/fd").iterdir()]


def sockets_of(pids: list[int]) -> set[str]:
    return {what[8:-1] for _, what in opened_by(pids) if what.startswith("socket:[")}


def rows(table: str) -> list[list[str]]:
    """The kernel's list of sockets of one kind, cut into its columns."""
    return [line.split() for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]


def address(column: str) -> IPv4Address:
    """The address of a column of /proc/net: hexadecimal, in the order of this machine's bytes."""
    return IPv4Address(int.from_bytes(bytes.fromhex(column.partition(":")[0]), sys.byteorder))


@pytest.mark.long
def test_sockets_are_of_this_machine_alone(bench: Bench) -> None:
    until(bench.start("watch", "--web", "--port", "0"), "http://")
    web = bench.processes.pop("watch")
    until(bench.start("watch", "--foxglove", "--open", "--port", "0"), "ws://")
    bench.processes["web"] = web
    own = sockets_of(bench.family())
    tcp = [row for row in rows("tcp") if row[9] in own]
    assert len([row for row in tcp if row[3] == LISTENS]) == 2, "the page and Foxglove's"
    assert {str(address(row[1])) for row in tcp} == {"127.0.0.1"}
    udp = [address(row[1]) for row in rows("udp") if row[9] in own]
    assert len(udp) >= 6, "emulator, controller and guardian, each with one to send and one to receive"
    assert all(one.is_loopback or one in BUSES for one in udp)
    assert not [row for table in ("tcp6", "udp6") for row in rows(table) if row[9] in own]
    named = {row[7] for row in rows("unix") if row[6] in own and len(row) > 7}
    assert named and all(CLAIM.fullmatch(name) for name in named), "claims of identifiers: nobody reads them"


@pytest.mark.long
@pytest.mark.skipif(os.getuid() != 0, reason="needs root to start a process of another user")
def test_another_user_gets_nowhere(bench: Bench) -> None:
    """The same, tried: another user reads no log, no ring, sets nothing, and can't stop the run."""
    until(bench.start("watch", "--web", "--port", "0"), "http://")
    run = bench.processes["run"]
    for path in (bench.folder, *bench.folder.parents):  # the way there is open, as in /tmp
        open_for_now(bench, path)
    log = only_log(bench.folder / "made" / "deep")
    entry = next(path for path in bench.files() if path.name == f"{run.pid}.json")
    ring = next(link for link, what in opened_by([run.pid]) if what.startswith("/memfd:hil-ticks"))
    page = next(link for link, what in opened_by([run.pid]) if what.startswith("/memfd:hil-setpoint"))
    assert all(refused("head", "-c1", str(path)) for path in (log, entry, ring, page))
    assert all(refused("ls", str(path.parent)) for path in (log, entry, ring, page))
    assert refused("sh", "-c", f"kill -TERM {run.pid}") and run.poll() is None
    assert not refused("ls", str(bench.folder)), "what is open is reached"


def refused(*command: str) -> bool:
    """True when another user can't do it."""
    return subprocess.run(command, user=NO_SUCH_USER, capture_output=True, check=False).returncode != 0


def open_for_now(bench: Bench, path: Path) -> None:
    """Open a folder for everybody until the test ends."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o055 != 0o055:
        path.chmod(mode | 0o055)
        bench.stack.callback(path.chmod, mode)
