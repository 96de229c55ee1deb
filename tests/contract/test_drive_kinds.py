"""Every kind of drive keeps the port (drivers/drive.py): the house's, and one from an outside package.

The package is examples/request_response, found by its entry points as if pip had installed it.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.bus import Frame
from drivers.drive import BUILT_IN, Drive, DriveKind, DriveKindError, drive_kind, kinds
from drivers.errors import LinkDown
from drivers.frames import FOREIGN_COMMAND, FRESH
from drivers.mapping import COMMANDED_D, COMMANDED_Q, MEASURED
from hil.check.checks import check, passed
from hil.errors import ConfigError
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import new_ticks
from tests.conftest import CONFIGS, ROOT

EXAMPLE = ROOT / "examples" / "request_response"
RUNS = {"dbc": CONFIGS / "demo.toml", "query": EXAMPLE / "query.toml"}
"""A run with a drive of each kind."""


def install(folder: Path, name: str, points: dict[str, dict[str, str]]) -> None:
    """What pip leaves of a package besides its files."""
    facts = folder / f"{name}-1.0.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    groups = [
        f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in given.items())
        for group, given in points.items()
    ]
    (facts / "entry_points.txt").write_text("\n".join(groups))


def install_example(folder: Path) -> None:
    shutil.copytree(EXAMPLE / "query_drive", folder / "query_drive")
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    install(folder, "query_drive", project["entry-points"])


@pytest.fixture(autouse=True)
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path with the example in it."""
    folder = tmp_path / "site"
    install_example(folder)
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "query_drive"]:
        del sys.modules[name]


class Wire:
    """A link that keeps what is sent and gives what is queued; ``down``: sending fails."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.queue: deque[Frame] = deque()
        self.answers: list[Frame] = []
        self.down = self.closed = False

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        if self.down:
            raise LinkDown(100, "down")
        self.sent.append((can_id, data))
        self.queue.extend(self.answers)

    def receive(self, timeout_ns: int) -> Frame | None:
        return self.queue.popleft() if self.queue else None

    def discard(self) -> int:
        count = len(self.queue)
        self.queue.clear()
        return count

    def close(self) -> None:
        self.closed = True


def opened(kind: str) -> tuple[Setup, Wire, Drive]:
    setup, wire = load_setup(RUNS[kind], Overrides()), Wire()
    return setup, wire, drive_kind(kind).open(wire, setup.database, drive_map=setup.binding.map)


def measured(drive: Drive) -> list[Frame]:
    """The frames with the measurements, all zero."""
    messages = [bound.message for bound in drive.binding.incoming if bound.has(MEASURED)]
    return [Frame(m.can_id, m.encode(dict.fromkeys(m.signals, 0.0)), 0, m.fd) for m in messages]


def test_every_kind_there_is_is_tried_here() -> None:
    assert set(kinds()) == set(RUNS) and set(BUILT_IN) == {"dbc"}


@pytest.mark.parametrize("kind", RUNS)
def test_a_kind_has_all_of_the_port_and_sends_nothing_by_itself(kind: str) -> None:
    _, wire, drive = opened(kind)
    assert isinstance(drive, Drive) and isinstance(drive_kind(kind), DriveKind)
    drive.prepare(new_ticks()[0])
    drive.listen(0.001)
    drive.discard()
    assert not drive.wait_for_drive(0.001) and drive.other_master(0.001) is None
    drive.restore(drive.saved())
    drive.flush()
    assert not wire.sent and drive.timed is None and not drive.odd_length()
    drive.close()
    assert wire.closed


@pytest.mark.parametrize("kind", RUNS)
def test_a_cycle_is_what_sync_names_then_the_measurements(kind: str) -> None:
    setup, wire, drive = opened(kind)
    tick = new_ticks()[0]
    drive.prepare(tick)
    wire.answers = measured(drive)
    drive.exchange(tick, 1)
    sync = setup.binding.sync
    assert sync is not None and [can_id for can_id, _ in wire.sent] == [sync.send_id]
    assert int(tick["rx_flags"]) & FRESH and tick["w"] == 0.0
    if drive_kind(kind).asked:
        assert wire.sent[0][1] == drive.request() != b""  # type: ignore[attr-defined]
        assert len(wire.sent[0][1]) == sync.length
    tick["rx_flags"] = 0
    drive.receive(tick, 0)
    assert not int(tick["rx_flags"]) & FRESH


@pytest.mark.parametrize("kind", RUNS)
def test_a_kind_hears_another_master(kind: str) -> None:
    setup, wire, drive = opened(kind)
    tick = new_ticks()[0]
    drive.prepare(tick)
    sync = setup.binding.sync
    for message in (setup.binding.command.message, sync):
        assert message is not None
        strange = Frame(message.can_id, bytes(message.length), 0, message.fd)
        wire.queue.append(strange)
        assert drive.other_master(0.01) == message.can_id
        wire.queue.append(strange)
        tick["rx_flags"] = 0
        drive.receive(tick, 0)
        assert int(tick["rx_flags"]) & FOREIGN_COMMAND


@pytest.mark.parametrize("kind", RUNS)
def test_a_kind_overhears_what_another_commands(kind: str) -> None:
    """No second master's then, and nothing is sent."""
    setup, wire, drive = opened(kind)
    seen, tick, command = drive.overhear(), new_ticks()[0], setup.binding.command
    drive.prepare(tick)
    assert len(seen) == 2 * (command.counter_modulus if setup.binding.map.echo else 1)
    parts = dict(command.parts)
    axes = [[parts[part] for part in axis if part in parts] for axis in (COMMANDED_Q, COMMANDED_D)]
    values = {name: 0.5 * (1 + place) for place, names in enumerate(axes) for name in names}
    counter = {command.counter: 3} if command.counter else {}
    data = command.message.encode({**dict.fromkeys(command.message.signals, 0), **values, **counter})
    for sent in (data, data[:-1]):
        wire.queue.append(Frame(command.message.can_id, sent, 0, command.message.fd))
    tick["rx_flags"] = 0
    drive.receive(tick, 0)
    assert not int(tick["rx_flags"]) and wire.sent == []
    row = 3 if setup.binding.map.echo else 0
    wanted = np.zeros((len(seen) // 2, 2))
    wanted[row] = [0.5 if axes[0] else 0.0, 1.0 if axes[1] else 0.0]
    assert seen.reshape(-1, 2) == pytest.approx(wanted, abs=1e-3)
    saved = drive.saved()
    seen[:] = 9.0
    drive.restore(saved)
    assert seen.reshape(-1, 2) == pytest.approx(wanted, abs=1e-3)


@pytest.mark.parametrize("kind", RUNS)
def test_only_a_kind_that_must_be_asked_is_asked_and_by_its_request_alone(kind: str) -> None:
    setup, wire, drive = opened(kind)
    drive.prepare(new_ticks()[0])
    wire.answers = measured(drive)
    asked = drive_kind(kind).asked
    assert drive.wait_for_drive(0.01, ask=asked) == asked
    sync = setup.binding.sync
    assert sync is not None and [can_id for can_id, _ in wire.sent] == [sync.send_id] * asked


@pytest.mark.parametrize("kind", RUNS)
def test_a_stop_commands_nothing_and_never_raises(kind: str) -> None:
    setup, wire, drive = opened(kind)
    drive.prepare(new_ticks()[0])
    drive.stop_from(3)
    command = setup.binding.command
    stops = [data for can_id, data in wire.sent if can_id == command.message.send_id]
    assert len(stops) >= 3
    for data in stops:
        values = command.message.decode(data)
        for part, signal in command.parts:
            if part in (*COMMANDED_Q, *COMMANDED_D, "controlword", "enable"):
                assert values[signal] == 0.0, part
    wire.down = True
    drive.stop()
    drive.leave()
    drive.close()


def test_a_kind_that_is_not_there_is_refused_with_those_there_are(outside: Path) -> None:
    with pytest.raises(ConfigError, match=r"drive\.kind: 'moteus' is not one of dbc, query; install"):
        load_setup(RUNS["dbc"], Overrides(settings=('drive.kind="moteus"',)))
    (outside / "broken.py").write_text("import nowhere_at_all\n")
    (outside / "other.py").write_text("MEMBER = 7\n")
    points = {"broken": "broken:MEMBER", "other": "other:MEMBER", "query": "other:MEMBER"}
    install(outside, "second", {"hil.drive": points})
    for name, said in [
        ("broken", "broken = broken:MEMBER: ModuleNotFoundError"),
        ("other", "other = other:MEMBER is no"),
        ("query", "named by other:MEMBER and query_drive.client:MEMBER; uninstall one"),
    ]:
        with pytest.raises(DriveKindError, match=said):
            drive_kind(name)
    assert drive_kind("dbc").asked is False


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ('drive.signals.sync=""', r"drive\.signals\.sync: missing; name the message that asks a query drive"),
        ('loop.pacing="timer"', r'loop\.pacing: a query drive speaks when it is asked; take "sync"'),
        ('bus.sync="kernel"', r'bus\.sync: "kernel" needs'),
    ],
)
def test_what_an_asked_drive_can_not_do_is_refused(setting: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_setup(RUNS["query"], Overrides(settings=('loop.clock="realtime"', setting)))


def test_a_check_before_it_is_asked_warns_and_does_not_fail(channel: str) -> None:
    settings = (f'bus.channel="{channel}"', "drive.heartbeat_timeout_s=0.05", "realtime.lock_memory=false")
    rows = check(load_setup(RUNS["query"], Overrides(settings=settings)))
    verdicts = {row.check: row.verdict for row in rows}
    assert verdicts["drive"] == verdicts["drive state"] == "warn" and passed(rows)


def hil(outside: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(outside), str(ROOT)])}
    return subprocess.run(
        [sys.executable, "-m", "hil.cli", *arguments],
        env=environment, cwd=outside, capture_output=True, text=True, timeout=250,
    )  # fmt: skip


@pytest.mark.process
def test_a_drive_of_an_outside_package_runs_in_lockstep_and_replays(outside: Path, tmp_path: Path) -> None:
    run = ("--set", f'log.folder="{tmp_path}"', "--set", 'log.name="query"')
    ran = hil(outside, "demo", str(RUNS["query"]), "--json", *run)
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert told["ended"] == "stop_requested" and told["skipped"] == 0 and 2.0 < told["dip_rad_s"] < 6.0
    again = hil(outside, "replay", str(tmp_path / "query.mcap"))
    assert again.returncode == 0 and "not compared" not in again.stdout, again.stdout


@pytest.mark.process
def test_a_drive_that_does_not_answer_is_never_commanded(outside: Path, channel: str, tmp_path: Path) -> None:
    settings = (f'bus.channel="{channel}"', "drive.heartbeat_timeout_s=0.2", f'log.folder="{tmp_path}"')
    ran = hil(outside, "run", str(RUNS["query"]), *(f"--set={setting}" for setting in settings))
    assert ran.returncode == 2 and "no command was sent" in ran.stderr, ran.stderr
