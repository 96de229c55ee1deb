"""A run's frames, exported, and imported again: the same ticks to the bit, and what is refused."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli import main
from hil.exchange.export import export
from hil.exchange.importing import OURS, THEIRS, import_recording
from hil.exchange.periods import Grid, Heard, Period, Roles, periods, with_ahead
from hil.exchange.recording import Recording
from hil.log.errors import LogError
from hil.log.reader import open_log
from hil.replay import replay
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup
from hil.signals import FIELDS, INPUTS, DriveState
from hil.sim.demo import emulator_process
from tests.conftest import CONFIGS

pytestmark = [pytest.mark.process, pytest.mark.beside]

NOT_ON_THE_WIRE = {"t_ns", "lateness_ns", "received_ns", "computed_ns", "sent_ns", "recorded_ns", "check"}
"""Times, and the check that a record carries over all its fields, these included; replay judges that."""


@dataclass(frozen=True)
class Ran:
    """A run: its config, what it was run with, its log."""

    config: Path
    settings: tuple[str, ...]
    log: Path


def ran(folder: Path, name: str, channel: str, *more: str) -> Ran:
    shutil.copytree(CONFIGS, folder / "configs")
    settings = (
        f'bus.channel="{channel}"', f'log.folder="{folder / "logs"}"', "realtime.lock_memory=false",
        "feedback.hold_ticks=150", "feedback.quick_stop_ticks=200", "loop.max_gap_ticks=64", *more,
    )  # fmt: skip
    path, overrides = folder / "configs" / name, Overrides(settings=settings)
    with emulator_process(path, overrides, ("firmware.watchdog_ms=400.0",)):
        return Ran(path, settings, Path(run(load_setup(path, overrides)).log))


@pytest.fixture(scope="module")
def steady(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """A second in lockstep, where stamps are deadlines."""
    more = ('loop.clock="lockstep"', "loop.duration_s=1.0", "reference.at_s=0.1")
    return ran(tmp_path_factory.mktemp("steady"), "demo.toml", "import-steady", *more)


def differing(log: Path, other: Path) -> set[str]:
    a, b = open_log(log).ticks, open_log(other).ticks
    assert len(a) == len(b) > 500
    return {field.name for field in FIELDS if a[field.name].tobytes() != b[field.name].tobytes()}


def there_and_back(one: Ran, folder: Path, ending: str) -> Path:
    """The log of a recording of the run, the same in every field."""
    recording, back = folder / f"a{ending}", folder / "back.mcap"
    export(one.log, recording, frames=True)
    found = import_recording(recording, back, one.config, one.settings)
    assert found.commands == OURS and found.ended == "stop_requested" and found.damage is None
    assert differing(one.log, back) == set()
    assert replay(back).verdict == "same"
    return back


@pytest.mark.corners
@pytest.mark.parametrize("ending", [".log", ".blf", ".asc", ".mf4"])
def test_there_and_back_is_the_same_in_every_field(steady: Ran, tmp_path: Path, ending: str) -> None:
    back = there_and_back(steady, tmp_path, ending)
    frames, again = open_log(steady.log).frames, open_log(back).frames
    assert [(f.received, f.can_id, f.data) for f in frames] == [(f.received, f.can_id, f.data) for f in again]


@pytest.fixture(scope="module")
def two_inputs(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """The paper's controller with a commanded load machine, on CAN FD."""
    return ran(tmp_path_factory.mktemp("fac"), "paper.toml", "import-fac", "loop.duration_s=1.0")


@pytest.mark.long
@pytest.mark.parametrize("ending", [".log", ".blf", ".asc", ".mf4"])
def test_fac_on_can_fd_there_and_back(two_inputs: Ran, tmp_path: Path, ending: str) -> None:
    back = there_and_back(two_inputs, tmp_path, ending)
    assert max(len(frame.data) for frame in open_log(back).frames) > 8


@pytest.mark.corners
@pytest.mark.parametrize("name", ["demo.toml", "inverter.toml"])
def test_a_run_in_real_time_comes_back_in_all_but_its_times(tmp_path: Path, name: str) -> None:
    """Lateness, skipped periods and late feedback of a busy host included; with SYNC and without."""
    one = ran(tmp_path, name, f"import-{name}", "loop.duration_s=1.5")
    export(one.log, tmp_path / "a.log")
    found = import_recording(tmp_path / "a.log", tmp_path / "back.mcap", one.config, one.settings)
    assert found.commands == OURS, found
    assert differing(one.log, tmp_path / "back.mcap") <= NOT_ON_THE_WIRE | {"k", "gap", "skipped"}
    a, b = open_log(one.log).ticks, open_log(tmp_path / "back.mcap").ticks
    operating = a["state"] == DriveState.OPERATION_ENABLED
    assert operating.sum() > 500
    for name in ("gap", "skipped"):  # while the drive is being enabled, no frame shows a skipped period
        assert np.array_equal(a[name][operating], b[name][operating]), name
    assert len(np.unique(a["k"][operating].astype(int) - b["k"][operating].astype(int))) == 1
    assert replay(tmp_path / "back.mcap").verdict == "same"


def test_a_drive_with_start_frames_comes_back(tmp_path: Path) -> None:
    """They are in its log, each once, before the first tick and in the order of their stamps."""
    one = ran(tmp_path, "odrive.toml", "import-odrive", "loop.duration_s=1.0")
    log = open_log(one.log)
    sent = [frame for frame in log.frames if not frame.received]
    assert [frame.can_id for frame in sent[:2]] == [0x38, 0x2B], "Clear_Errors, Set_Controller_Mode"
    stamps = [frame.t_ns for frame in sent[:2]]
    assert stamps == sorted(stamps) and stamps[1] < int(log.ticks["t_ns"][0])
    export(one.log, tmp_path / "a.log")
    found = import_recording(tmp_path / "a.log", tmp_path / "back.mcap", one.config, one.settings)
    assert found.commands == OURS and found.damage is None, found
    assert replay(tmp_path / "back.mcap").verdict == "same"


def test_a_drive_that_its_command_asks_is_refused(steady: Ran, tmp_path: Path) -> None:
    """In one line, and nothing is written."""
    recording, back = tmp_path / "a.log", tmp_path / "back.mcap"
    export(steady.log, recording, frames=True)
    with pytest.raises(LogError, match=r"moteus.toml: drive.signals.poll: a recording .* can't be") as caught:
        import_recording(recording, back, CONFIGS / "moteus.toml", ())
    assert "\n" not in str(caught.value) and not back.exists()


@pytest.fixture(scope="module")
def other_protocol(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """A drive of another protocol: big endian, extended identifiers, CAN FD, no SYNC."""
    return ran(tmp_path_factory.mktemp("inverter"), "inverter.toml", "import-other", "loop.duration_s=1.0")


@pytest.mark.corners
@pytest.mark.parametrize("ending", [".log", ".blf", ".asc", ".mf4"])
def test_another_protocol_through_every_format_into_replay_and_report(
    other_protocol: Ran, tmp_path: Path, ending: str, capsys: Any
) -> None:
    """Whatever the format, the log that comes back is the same in all but its times."""
    recording, back = tmp_path / f"a{ending}", tmp_path / "back.mcap"
    words = ["--config", str(other_protocol.config)]
    words += [w for setting in other_protocol.settings for w in ("--set", setting)]
    assert main(["export", str(other_protocol.log), "-o", str(recording), "--frames"]) == 0
    capsys.readouterr()
    assert main(["import", str(recording), "-o", str(back), *words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["commands"] == OURS and found["damage"] is None, found
    assert differing(other_protocol.log, back) <= NOT_ON_THE_WIRE | {"k", "gap", "skipped"}
    assert main(["replay", str(back), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "same"
    assert main(["report", str(back), "-o", str(tmp_path / "r.html"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"][0]["replay"]["verdict"] == "same"


def test_another_controllers_commands_are_open_loop(steady: Ran, tmp_path: Path, capsys: Any) -> None:
    export(steady.log, tmp_path / "a.log")
    back, other = tmp_path / "back.mcap", (*steady.settings, "controller.speed_pole_rad_s=25.0")
    found = import_recording(tmp_path / "a.log", back, steady.config, other)
    assert found.commands.startswith(THEIRS) and "sends something else" in found.commands
    assert replay(back).verdict == "same"
    a, b = open_log(steady.log).ticks, open_log(back).ticks
    for name in set(INPUTS) - {"request", "u_q_seen", "u_d_seen", "w_ref", "dw_ref"}:
        assert a[name].tobytes() == b[name][: len(a)].tobytes(), name
    echoed = a["drive_state"] == 4
    applied = np.array(
        [a["u_q"][a["counter"] == c][0] if (a["counter"] == c).any() else 0 for c in range(16)]
    )
    assert echoed.sum() > 900 and len(applied) == 16
    rows = np.nonzero(echoed)[0]
    assert np.array_equal(b["u_q_seen"][rows[1:]], a["u_q"][rows[1:] - 1]), (
        "applied from now on: the last sent"
    )
    assert (b["send"] == 0).all()
    assert main(["report", str(back), "-o", str(tmp_path / "r.html"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"][0]["replay"]["verdict"] == "same"


Edit = Callable[[list[str]], list[str]]


def restamped(rows: list[str], new: Callable[[int, int], int]) -> list[str]:
    """Lines of candump with other stamps: ``new`` of the line's number and its stamp [us]."""
    pairs = (row[1:].split(")", 1) for row in rows)
    stamps = ((new(at, int(stamp.replace(".", ""))), rest) for at, (stamp, rest) in enumerate(pairs))
    return [f"({us // 1_000_000}.{us % 1_000_000:06d}){rest}" for us, rest in stamps]


def later(rows: list[str], seconds: int, since: float = 0.5) -> list[str]:
    """The rows, from a share of them on so much later."""
    return restamped(rows, lambda at, us: us + (seconds * 1_000_000 if at >= since * len(rows) else 0))


def with_line(rows: list[str], body: str, at: int = 300) -> list[str]:
    return [*rows[:at], f"{rows[at].split()[0]} can0 {body}\n", *rows[at:]]


BAD: dict[str, tuple[Edit, str]] = {
    "no feedback": (lambda rows: [row for row in rows if " 181#" not in row], "no valid feedback.*181"),
    "other identifiers": (lambda rows: [row.replace(" 080#", " 090#") for row in rows], "SYNC 80; seen:.*90"),
    "time goes back": (lambda rows: rows[300:] + rows[:300], "time goes back by 1.5"),
    "two channels": (lambda rows: [*rows[:50], *(r.replace("can0", "can1") for r in rows[50:])], "--channel"),
    "an hour later": (lambda rows: later(rows, 3600), "time jumps by 3600.*cut it there"),
    "50 days later": (lambda rows: later(rows, 50 * 86400), "time jumps by 4320000"),
    "a week, then back": (
        lambda rows: later(later(rows, 604800, 0.3), -604800, 0.6),
        "time goes back by 604",
    ),
    "stamps of 10 ms": (lambda rows: restamped(rows, lambda _, us: us // 10_000 * 10_000), "steps of 10 ms"),
    "stamps of 1 s": (lambda rows: restamped(rows, lambda _, us: us // 10**6 * 10**6), "steps of 1000 ms"),
    "stamp nan": (lambda rows: ["(nan) can0 181#00\n", *rows], r"1 of \d+ lines can't be read \(line 1: "),
    "9 bytes": (lambda rows: with_line(rows, "181#112233445566778899"), "no frame holds 9 bytes"),
    "identifiers of another kind": (
        lambda rows: [row.replace(" 181#", " 00000181#") for row in rows],
        r"feedback 181, .*181x \(29 bits\)",
    ),
    "empty": (lambda rows: [], "has no frames"),
    "noise": (lambda rows: ["\x00\xff no frame\n"], r"not a candump -l log: it begins '\\x00"),
}


@pytest.mark.parametrize("case", list(BAD))
def test_what_is_refused_names_the_trouble_and_leaves_nothing(steady: Ran, tmp_path: Path, case: str) -> None:
    edit, words = BAD[case]
    export(steady.log, tmp_path / "a.log")
    rows = (tmp_path / "a.log").read_text().splitlines(keepends=True)
    (tmp_path / "b.log").write_text("".join(edit(rows)))
    with pytest.raises(LogError, match=words):
        import_recording(tmp_path / "b.log", tmp_path / "back.mcap", steady.config, steady.settings)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.log", "b.log"]


GOOD: dict[str, Edit] = {
    "a bus error": lambda rows: with_line(rows, "20000088#0000080000000000 R"),
    "a controller error, no direction": lambda rows: with_line(rows, "20000004#0030000000008888"),
    "an error of SYNC's class": lambda rows: with_line(rows, "20000080#0000080000000000 R"),
    "an error of COMMAND's class": lambda rows: with_line(rows, "20000201#0000080000000000 R"),
    "a raw DLC": lambda rows: with_line(rows, "7A0#1122334455667788_C R"),
    "a remote frame of SYNC's identifier": lambda rows: with_line(rows, "080#R R"),
    "12 bytes without the flag": lambda rows: with_line(rows, "7A0#112233445566778899AABBCC R"),
    "a frame an hour after the run": lambda rows: later([*rows, rows[-1]], 3600, 1 - 1 / (2 * len(rows))),
}


@pytest.mark.corners
@pytest.mark.parametrize("case", list(GOOD))
def test_what_is_none_of_the_runs_frames_changes_no_command(steady: Ran, tmp_path: Path, case: str) -> None:
    """And comes back from our own exports as what it was."""
    export(steady.log, tmp_path / "a.log")
    rows = GOOD[case]((tmp_path / "a.log").read_text().splitlines(keepends=True))
    (tmp_path / "b.log").write_text("".join(rows))
    found = import_recording(tmp_path / "b.log", tmp_path / "b.mcap", steady.config, steady.settings)
    assert found.commands == OURS and found.ended == "stop_requested" and found.frames == len(rows)
    wanted = list(Recording(tmp_path / "b.log").frames())
    for ending in (".log", ".asc", ".blf", ".mf4"):
        export(tmp_path / "b.mcap", tmp_path / f"c{ending}", frames=True)
        again = Recording(tmp_path / f"c{ending}").frames()
        assert [one[2:] for one in again] == [one[2:] for one in wanted], ending


def relative(lines: list[str]) -> list[str]:
    """ASC with each time as the distance from the line before it."""
    out, before = [], Decimal(0)
    for line in lines:
        stamp, _, rest = line.strip().partition(" ")
        if re.fullmatch(r"\d+\.\d+", stamp):
            out.append(f" {Decimal(stamp) - before} {rest}")
            before = Decimal(stamp)
        else:
            out.append(line.replace("timestamps absolute", "timestamps relative"))
    return out


def requested(lines: list[str]) -> list[str]:
    """ASC of a recorder that writes what is asked to be sent as well as what was."""
    return [new for line in lines for new in ([line.replace(" Tx  ", " TxRq")] * (" Tx  " in line) + [line])]


@pytest.mark.parametrize("edit", [relative, requested], ids=["relative times", "TxRq"])
def test_dialects_of_asc_are_the_same_run(steady: Ran, tmp_path: Path, edit: Edit) -> None:
    export(steady.log, tmp_path / "a.asc")
    lines = edit((tmp_path / "a.asc").read_text().splitlines())
    (tmp_path / "b.asc").write_text("\n".join(lines) + "\n")
    found = import_recording(tmp_path / "b.asc", tmp_path / "b.mcap", steady.config, steady.settings)
    assert (
        found.commands == OURS and found.ended == "stop_requested" and len(found.notes) == (edit is requested)
    )
    assert differing(steady.log, tmp_path / "b.mcap") == set()
    started = [open_log(path).metadata["run"]["started"][:22] for path in (steady.log, tmp_path / "b.mcap")]
    assert started[0] == started[1], "to the millisecond and below"


@pytest.mark.parametrize("ending", [".log", ".blf"])
def test_a_recording_cut_off_counts_as_far_as_it_goes(steady: Ran, tmp_path: Path, ending: str) -> None:
    export(steady.log, tmp_path / f"a{ending}")
    raw = (tmp_path / f"a{ending}").read_bytes()
    (tmp_path / f"b{ending}").write_bytes(raw[: len(raw) * 6 // 10])
    back = tmp_path / "back.mcap"
    with pytest.raises(LogError, match=r"--partial takes the \d+ frames"):
        import_recording(tmp_path / f"b{ending}", back, steady.config, steady.settings)
    found = import_recording(tmp_path / f"b{ending}", back, steady.config, steady.settings, partial=True)
    assert found.damage is not None
    assert 100 < found.ticks < 1004 and found.commands == OURS and found.ended == "the recording ends here"
    a, b = open_log(steady.log).ticks, open_log(back).ticks
    assert all(a[f.name][: len(b)].tobytes() == b[f.name].tobytes() for f in FIELDS)
    assert replay(back).verdict == "same"


def test_the_command_refuses_in_one_line(steady: Ran, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "a.txt").write_text("x")
    words = [
        "import",
        str(tmp_path / "a.txt"),
        "-o",
        str(tmp_path / "b.mcap"),
        "--config",
        str(steady.config),
    ]
    assert main(words) == 2
    assert ".blf" in capsys.readouterr().err


MS = 1_000_000
ROLES = Roles(0x80, frozenset({0x181}), {0x201})
CYCLIC = Roles(None, frozenset({0x181}), {0x201})


def heard(*rows: tuple[float, int]) -> list[Heard]:
    return [Heard(round(t * MS), can_id, can_id == 0x181, False, b"") for t, can_id in rows]


def shape(found: list[Period]) -> list[tuple[int, int, int]]:
    return [(len(p.late), len(p.answers), len(p.commands)) for p in found]


def test_feedback_after_the_command_is_late_for_the_next_tick() -> None:
    rows = heard((0, 0x80), (0.9, 0x201), (0.95, 0x181), (1, 0x80), (1.1, 0x181), (1.2, 0x201), (2, 0x80))
    assert shape(list(periods(rows, ROLES, MS // 2, MS))) == [(0, 0, 1), (1, 1, 1), (0, 0, 0)]
    assert shape(list(periods(heard((0, 0x80), (0.9, 0x181), (1, 0x80)), ROLES, MS // 2, MS)))[0] == (0, 0, 0)


def test_a_cyclic_drive_whose_measurement_got_no_command() -> None:
    rows = [(0, 0x181), (0.1, 0x201), (1, 0x181), (2, 0x181), (2.1, 0x201), (3, 0x181), (3.1, 0x201)]
    assert shape(list(periods(heard(*rows), CYCLIC, MS, MS))) == [(0, 1, 1), (0, 2, 1), (0, 1, 1)]
    alone = list(periods(heard(*((t, 0x181) for t in range(5))), CYCLIC, MS, MS))
    assert shape(alone) == [(0, 1, 0)] * 5, "a drive that nobody commands"


@pytest.mark.parametrize(
    ("stamps", "gaps"),
    [
        ([0, 1, 2, 3], [1, 1, 1, 1]),
        ([0, 1, 3.2, 4, 5], [1, 1, 2, 1, 1]),
        (
            [0, 1, 3.1, 3.2, 4, 5],
            [1, 1, 1, 1, 1, 1],
        ),  # held up between waking and SYNC: no period was skipped
        ([0, 1, 7.5, 8, 9], [1, 1, 6, 1, 1]),
    ],
)
def test_gaps_by_the_stamps_of_sync(stamps: list[float], gaps: list[int]) -> None:
    grid, found = Grid(MS), []
    for period, ahead in with_ahead(Period(round(t * MS)) for t in stamps):
        found.append(grid.gap(period.t_ns, ahead))
        grid.place(period.t_ns, found[-1])
    assert found == gaps


@pytest.mark.parametrize("drift", [-300e-6, 300e-6])
def test_a_recorders_clock_that_drifts_skips_nothing(drift: float) -> None:
    grid, rng = Grid(MS), np.random.default_rng(3)
    stamps = (np.arange(20_000) * MS * (1 + drift) + rng.exponential(0.03, 20_000) * MS).astype(int).tolist()
    for period, ahead in with_ahead(Period(t) for t in stamps):
        gap = grid.gap(period.t_ns, ahead)
        assert gap == 1, f"seed 3, tick {grid.k}"
        grid.place(period.t_ns, gap)
