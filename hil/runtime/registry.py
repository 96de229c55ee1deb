"""Which runs of this user are running: one small file each in a folder that only the user can open.

The file is written before the loop starts and removed after its end. A run that was killed leaves its file;
it is recognised by process id and start time, and removed by whoever looks next. A stop is asked for by a
note beside that file, which says who asked, and the signal that already means an orderly stop.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import stat
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from hil.errors import HilError
from hil.runtime.clock import RealClock


class WatchError(HilError, RuntimeError):
    """There is no such run, or it can't be looked at."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A running run. ``start``: clock ticks after boot, so that a reused process id is no mistake."""

    pid: int
    start: int
    log: str
    bus: str
    rate_hz: int
    ticks: int | None = None
    clock: str = "monotonic"
    takes: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """What ``hil set`` may ask, by name: least, most, rate [SI]; of several nodes, of the first."""
    nodes: tuple[str, ...] = ()
    """Of a run with several nodes their names, in the configuration's order."""
    node_takes: dict[str, dict[str, tuple[float, float, float]]] = field(default_factory=dict)
    """Of a run with several nodes what may be asked of each."""

    def takes_of(self, node: str) -> dict[str, tuple[float, float, float]]:
        """What may be asked of a node; empty: the first, or the one drive."""
        return self.node_takes.get(node, {}) if node else self.takes

    def place_of(self, node: str) -> int:
        """A node's place in the configuration's order; empty: the first, or the one drive."""
        return self.nodes.index(node) if node else 0

    def __str__(self) -> str:
        return f"PID {self.pid} on {self.bus}, log {self.log}"


def folder() -> Path:
    """The registry's folder, made when missing. Raises WatchError when others could write into it."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    path = Path(base) / "hil" if base else Path(tempfile.gettempdir()) / f"hil-{os.getuid()}"
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        own = _is_own(path)
    except OSError as error:
        raise WatchError(f"{path}: can't be used for the list of runs ({error.strerror})") from error
    if not own:
        raise WatchError(f"{path}: is not a folder that only this user can open; remove it")
    return path


def _is_own(path: Path) -> bool:
    """Whether it is a folder that only this user can open. Raises OSError when there is none."""
    found = path.lstat()
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077


def elsewhere() -> list[Path]:
    """Where runs list themselves that were started in another environment: by a system unit, by cron."""
    user = os.getuid()
    return [
        Path(f"/run/user/{user}/hil"),
        Path(tempfile.gettempdir()) / f"hil-{user}",
        Path(f"/tmp/hil-{user}"),  # noqa: S108 - read only, and only a folder that is this user's alone
    ]


def folders() -> list[Path]:
    """All folders in which a run of this user may be listed, this environment's own first."""
    found = {folder(): None}
    for path in elsewhere():
        with contextlib.suppress(OSError):
            if _is_own(path):
                found[path] = None
    return list(found)


def start_time(pid: int) -> int | None:
    """Start of a process in clock ticks after boot; None when there is none (a zombie has ended)."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()  # the name before it may hold anything
    return None if fields[0] in "ZX" else int(fields[19])


def is_alive(entry: Entry) -> bool:
    """True while that very process runs."""
    return start_time(entry.pid) == entry.start


def _write_new(path: Path, value: Any) -> None:
    """Write a file that only this user can read; whole or not there. Raises FileExistsError."""
    fd, name = tempfile.mkstemp(dir=path.parent, prefix=".")  # 0600 from the beginning
    try:
        with os.fdopen(fd, "w", encoding="utf-8") as file:
            json.dump(value, file)
        os.link(name, path)
    finally:
        Path(name).unlink()


def own_entry(
    log: Path,
    bus: str,
    rate_hz: int,
    ticks: int | None,
    clock: str = RealClock.name,
    takes: dict[str, tuple[float, float, float]] | None = None,
    nodes: Mapping[str, dict[str, tuple[float, float, float]]] | None = None,
) -> Entry:
    """The entry of this process; ``clock``: the name of its loop's."""
    start, of_each = start_time(os.getpid()) or 0, dict(nodes or {})
    named = takes or {}, tuple(of_each), of_each
    return Entry(os.getpid(), start, str(log), bus, rate_hz, ticks, clock, *named)


@contextlib.contextmanager
def announced(entry: Entry) -> Iterator[None]:
    """List the run while the block runs. A folder that can't be used is no reason not to run."""
    path: Path | None = None
    with contextlib.suppress(WatchError, OSError):
        path = folder() / f"{entry.pid}.json"
        for old in (path, path.with_suffix(".stop")):
            old.unlink(missing_ok=True)
        _write_new(path, asdict(entry))
    try:
        yield
    finally:
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def runs() -> list[Entry]:
    """All running runs of this user, oldest first; what is left of dead ones is removed."""
    found = []
    for path in sorted(path for place in folders() for path in place.glob("*.json")):
        entry = _read(path)
        if entry is not None and is_alive(entry):
            found.append(entry)
        else:
            path.unlink(missing_ok=True)
            path.with_suffix(".stop").unlink(missing_ok=True)
    return sorted(found, key=lambda entry: entry.start)


def _listed(entry: Entry) -> Path | None:
    """The file that lists a run."""
    paths = [place / f"{entry.pid}.json" for place in folders()]
    return next((path for path in paths if _read(path) == entry), None)


def _read(path: Path) -> Entry | None:
    try:
        entry = Entry(**json.loads(path.read_text(encoding="utf-8")))
        return replace(entry, nodes=tuple(entry.nodes))
    except (OSError, ValueError, TypeError):
        return None


def matching(wanted: str | None) -> list[Entry]:
    """Runs whose PID, log, bus or channel is ``wanted``; all when it is None."""
    if wanted is None:
        return runs()
    log = str(Path(wanted).resolve())
    return [
        e
        for e in runs()
        if wanted in (str(e.pid), e.bus, e.bus.partition(":")[2], Path(e.log).stem) or log == e.log
    ]


def choose(wanted: str | None) -> Entry:
    """The one run that is meant. Raises WatchError when there is none or more than one."""
    found = matching(wanted)
    if len(found) == 1:
        return found[0]
    if found:
        which = "\n".join(f"  {entry}" for entry in found)
        raise WatchError(f"{len(found)} runs: say which by PID, channel or log\n{which}")
    if wanted is None:
        raise WatchError("no run of this user is running; start one: hil run CONFIG")
    if wanted.isdigit():
        raise WatchError(_why_not(int(wanted)))
    raise WatchError(f"no run with PID, channel or log {wanted!r} is running")


def _why_not(pid: int) -> str:
    """Why a process id is none of ours."""
    try:
        owner = Path(f"/proc/{pid}").stat().st_uid
    except OSError:
        return f"process {pid}: there is none"
    if owner != os.getuid():
        return f"process {pid} belongs to another user (uid {owner}); only its owner can watch it"
    return f"process {pid} is no hil run"


def no_node(entry: Entry, node: str) -> str:
    """Why a run has no such node; empty where it has, and for none named."""
    if not node or node in entry.nodes:
        return ""
    known = f"it has {' and '.join(entry.nodes)}" if entry.nodes else "it is of one drive: leave the node out"
    return f"{entry} has no node {node!r:.40}; {known}"


def ask_stop(entry: Entry, who: str, t_ns: int, k: int) -> bool:
    """Ask a run for an orderly stop, once; False when somebody has asked or it has ended.

    The process is held by a pidfd before it is checked, so that the signal can't reach another one. A second
    signal would be a quick stop, hence the note that can be made only once.
    """
    try:
        fd = os.pidfd_open(entry.pid)
    except OSError:
        return False
    try:
        path = _listed(entry)
        if not is_alive(entry) or path is None:
            return False
        _write_new(path.with_suffix(".stop"), {"who": who, "t_ns": t_ns, "k": k})
        signal.pidfd_send_signal(fd, signal.SIGTERM)
    except (FileExistsError, ProcessLookupError):
        return False
    finally:
        os.close(fd)
    return True


def who_asked(pid: int) -> tuple[int, int, str] | None:
    """Take the note of a stop: (t_ns, k, who); None when there is none."""
    with contextlib.suppress(WatchError, OSError, ValueError, KeyError, TypeError):
        path = folder() / f"{pid}.stop"
        note = json.loads(path.read_text(encoding="utf-8"))
        path.unlink()
        return int(note["t_ns"]), int(note["k"]), str(note["who"])
    return None
