"""Frames back on a bus: which, when, how late, who may; and what python-can hears and plays itself."""

from __future__ import annotations

import gc
import json
import os
import pty
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hil.cli import main
from hil.commands.play import Keys
from hil.exchange.export import export
from hil.exchange.play import LEAD_NS, Choice, Played, Source, ahead, chosen, play
from hil.log.errors import LogError
from hil.log.schema import FRAME, Records
from hil.runtime.clock import FakeClock
from tests.logfiles import some_ticks, write_log

pytestmark = pytest.mark.slow

IDS = ((0x080, 0, 1), (0x181, 1, 8), (0x201, 0, 8))
PERIOD_NS = 1_000_000


def bus_frames(count: int) -> Records:
    """SYNC, FEEDBACK, COMMAND of so many ticks, 0.1 ms apart."""
    frames = np.zeros(count * 3, FRAME)
    for at, (can_id, received, size) in enumerate(IDS):
        own = frames[at::3]
        own["can_id"], own["received"], own["size"] = can_id, received, size
        own["t_ns"] = np.arange(count) * PERIOD_NS + at * 100_000
        own["data"][:, 0] = np.arange(count)
    return frames


FRAMES = bus_frames(100)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_log(tmp_path / "run.mcap", some_ticks(100), FRAMES, block=25)
    return tmp_path / "run.mcap"


class Bus:
    """Keeps what is sent and when."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock, self.sent = clock, []  # type: ignore[var-annotated]

    def __call__(self, can_id: int, data: bytes, fd: bool) -> None:
        self.sent.append((self.clock.now_ns(), can_id, data, fd))


def played(path: Path, choice: Choice, rate: float = 1.0, loops: int = 1, late: Any = ()) -> tuple[Bus, Any]:
    clock = FakeClock(late)
    bus, source = Bus(clock), Source(path)
    return bus, play((chosen(source, choice) for _ in range(loops)), bus, clock, rate=rate)


def test_by_default_only_what_the_drive_sent_at_its_distances(path: Path) -> None:
    bus, result = played(path, Choice())
    assert {can_id for _, can_id, _, _ in bus.sent} == {0x181} and result.sent == 100
    assert np.array_equal(np.diff([t for t, *_ in bus.sent]), np.full(99, PERIOD_NS))
    assert bus.sent[0][0] == LEAD_NS and [d[0] for _, _, d, _ in bus.sent] == list(range(100))


def test_rate_loop_window_direction_and_identifiers(path: Path) -> None:
    bus, _ = played(path, Choice("both", frozenset(), frozenset({0x080}), 0.010, 0.0199), rate=4.0, loops=2)
    assert [can_id for _, can_id, _, _ in bus.sent] == [0x181, 0x201] * 20
    assert [d[0] for _, _, d, _ in bus.sent[:20:2]] == list(range(10, 20))
    assert set(np.diff([t for t, *_ in bus.sent[:20]]).tolist()) == {25_000, 225_000}
    bus, _ = played(path, Choice("tx", frozenset({0x201})))
    assert {can_id for _, can_id, _, _ in bus.sent} == {0x201} and len(bus.sent) == 100


def test_frames_read_ahead_are_the_same(path: Path) -> None:
    source = Source(path)
    rounds = [
        list(chosen(source, Choice("both"))),
        [],
        [Played(-1, 0x9FFFFFFF, bytes(range(64)), True, True)],
    ]
    with ahead(rounds) as read:
        assert [list(frames) for frames in read] == [*rounds, []]


def test_what_the_reader_can_not_read_is_said_where_it_is_played(path: Path) -> None:
    def broken() -> Iterator[Played]:
        yield from chosen(Source(path), Choice())
        raise LogError("the rest is torn")

    clock = FakeClock()
    bus = Bus(clock)
    with pytest.raises(LogError, match="the rest is torn"), ahead([broken()]) as read:
        play(read, bus, clock)
    assert len(bus.sent) == 100


def test_a_reader_that_dies_is_said_and_one_that_nobody_listens_to_ends() -> None:
    def endless() -> Iterator[Played]:
        while True:
            yield Played(0, 1, b"", False, False)

    with ahead([endless()]) as read:
        frames = next(read)
        assert next(frames).can_id == 1
    dying = (os.kill(os.getpid(), signal.SIGKILL) for _ in range(1))
    with pytest.raises(LogError, match="has died"), ahead(dying) as read:  # type: ignore[arg-type]
        list(next(read))


def test_lateness_is_counted_and_does_not_move_later_deadlines(path: Path) -> None:
    bus, result = played(path, Choice(), late=[0] * 50 + [5_000_000])
    assert result.late == 4 and result.max_us == 5000.0  # 5, 4, 3, 2 ms
    assert result.quantile_us(0.5) == 1.0 and result.quantile_us(0.97) == 2001.0
    assert bus.sent[-1][0] == LEAD_NS + 99 * PERIOD_NS


def test_a_long_way_to_the_first_frame_makes_none_late(path: Path) -> None:
    """Reading up to the window takes its time; the distances count from there."""
    clock = FakeClock()
    bus, source = Bus(clock), Source(path)

    def slowly() -> Iterator[Played]:
        clock.advance(500_000_000)
        yield from chosen(source, Choice(from_s=0.05))

    result = play([slowly()], bus, clock)
    assert result.sent == 50 and result.max_us == 0.0
    assert np.array_equal(np.diff([t for t, *_ in bus.sent]), np.full(49, PERIOD_NS))


def test_lateness_beyond_the_histogram_is_the_largest(path: Path) -> None:
    _, result = played(path, Choice(), late=[0] * 50 + [700_000_000])
    assert result.quantile_us(0.99) == result.max_us == 700_000.0 and result.quantile_us(0.5) == 1.0


@pytest.mark.long
def test_the_collector_does_not_look_at_old_objects_while_playing(path: Path) -> None:
    frozen = []

    def send(*frame: Any) -> None:
        frozen.append(gc.get_freeze_count())

    play([chosen(Source(path), Choice())], send, FakeClock())
    assert min(frozen) > 1000 and gc.get_freeze_count() == 0


BAD_FLAGS = {
    "rate 0": (["--rate", "0"], "above 0"),
    "rate nan": (["--rate", "nan"], "above 0"),
    "rate word": (["--rate", "fast"], "'fast' must be a number"),
    "loop 0": (["--loop", "0"], "1 or more"),
    "loop word": (["--loop", "twice"], "'twice' must be a whole number"),
    "id word": (["--id", "181h"], "'181h' must be an identifier"),
    "id negative": (["--not-id", "-1"], "below 2^29"),
    "id too large": (["--id", "0x20000000"], "below 2^29"),
    "window backwards": (["--from", "1", "--to", "0.5"], "--from 1 --to 0.5: no such window"),
    "window before the log": (["--from", "-1"], "no such window"),
    "window nan": (["--from", "nan"], "no such window"),
}


@pytest.mark.parametrize("case", list(BAD_FLAGS))
def test_flags_that_make_no_sense_are_refused(path: Path, channel: str, capsys: Any, case: str) -> None:
    flags, said = BAD_FLAGS[case]
    try:
        code = main(["play", str(path), "-i", "hil-local", "-c", channel, *flags])
    except SystemExit as refused:  # argparse's own way out
        code = int(refused.code or 0)
    assert code == 2 and said in capsys.readouterr().err


def test_a_damaged_log_is_played_as_far_as_it_goes_and_says_so(
    path: Path, tmp_path: Path, channel: str, capsys: Any
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    assert main(["play", str(cut), "-i", "hil-local", "-c", channel, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert 0 < found["frames sent"] < 100 and found["log"].startswith("damaged")


def test_ctrl_c_ends_at_once_with_what_was_played(path: Path) -> None:
    clock, sent = FakeClock(), []  # type: ignore[var-annotated]

    def send(*frame: Any) -> None:
        if len(sent) == 7:
            raise KeyboardInterrupt
        sent.append(frame)

    result = play([chosen(Source(path), Choice())], send, clock)
    assert result.interrupted and result.sent == 7


def test_a_command_is_known_by_its_identifier_whoever_sent_it(tmp_path: Path) -> None:
    frames = FRAMES.copy()
    frames["received"][5] = 1  # a COMMAND of somebody else
    write_log(tmp_path / "run.mcap", some_ticks(100), frames)
    source = Source(tmp_path / "run.mcap")
    assert source.roles_known and all(f.command == (f.can_id != 0x181) for f in source.frames())


def test_roles_are_not_known_in_shadow_logs_and_recordings(path: Path, tmp_path: Path) -> None:
    frames = FRAMES.copy()
    frames["received"] = 1
    write_log(tmp_path / "shadow.mcap", some_ticks(100), frames)
    export(path, tmp_path / "a.log")
    assert not Source(tmp_path / "shadow.mcap").roles_known and not Source(tmp_path / "a.log").roles_known


@pytest.mark.parametrize(
    "more",
    [
        ["--direction", "both"],
        ["--direction", "tx"],
        ["--direction", "both", "--yes"],
        ["--direction", "both", "--transmit-commands"],
    ],
)
def test_commands_are_refused_on_a_bus_that_may_be_real(path: Path, capsys: Any, more: list[str]) -> None:
    assert main(["play", str(path), "-c", "can99", *more]) == 2
    assert "--transmit-commands" in capsys.readouterr().err


def test_a_recording_is_refused_on_a_bus_that_may_be_real(path: Path, tmp_path: Path, capsys: Any) -> None:
    export(path, tmp_path / "a.log")
    assert main(["play", str(tmp_path / "a.log"), "-c", "can99"]) == 2
    assert "--transmit-commands" in capsys.readouterr().err


@pytest.mark.parametrize("more", [[], ["--direction", "both", "--transmit-commands", "--yes"]])
def test_what_is_allowed_gets_as_far_as_the_interface(path: Path, capsys: Any, more: list[str]) -> None:
    assert main(["play", str(path), "-c", "can99", *more]) == 2
    assert "can't open bus socketcan:can99" in capsys.readouterr().err


def heard(bus: can.BusABC, count: int) -> list[tuple[int, bytes]]:
    messages = [bus.recv(10.0) for _ in range(count)]
    return [(m.arbitration_id, bytes(m.data)) for m in messages if m is not None]


WANTED = [(int(f["can_id"]), bytes(f["data"][: f["size"]])) for f in FRAMES]


def test_long_frames_need_fd_and_the_refusal_says_so(tmp_path: Path, channel: str, capsys: Any) -> None:
    frames = FRAMES.copy()
    frames["size"] = 64
    write_log(tmp_path / "run.mcap", some_ticks(100), frames)
    words = ["play", str(tmp_path / "run.mcap"), "-i", "hil-local", "-c", channel, "--rate", "5"]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("hil: can't send a CAN FD frame") and "--fd" in error and "Errno" not in error
    with can.Bus(interface="hil-local", channel=channel, fd=True) as bus:
        assert main([*words, "--fd"]) == 0
        assert [len(data) for _, data in heard(bus, 100)] == [64] * 100


@pytest.mark.parametrize("ending", [".mcap", ".log", ".asc", ".blf", ".mf4"])
def test_python_can_hears_every_frame_of_a_log_and_of_its_exports(
    path: Path, channel: str, ending: str, capsys: Any
) -> None:
    source = path.with_suffix(ending)
    if ending != ".mcap":
        export(path, source, frames=True)
    with can.Bus(interface="hil-local", channel=channel) as bus:
        flags = ["-i", "hil-local", "-c", channel, "--direction", "both", "--rate", "5", "--json"]
        assert main(["play", str(source), *flags]) == 0
        assert heard(bus, len(WANTED)) == WANTED
    assert '"frames sent": 300' in capsys.readouterr().out


def test_can_player_plays_an_exported_log(path: Path, channel: str, monkeypatch: Any) -> None:
    from can import player

    export(path, path.with_suffix(".log"))
    with can.Bus(interface="hil-local", channel=channel) as bus:
        argv = ["can_player", "-i", "hil-local", "-c", channel, "-g", "0.0001", "-v"]
        monkeypatch.setattr("sys.argv", [*argv, str(path.with_suffix(".log"))])
        player.main()
        assert heard(bus, len(WANTED)) == WANTED


def test_what_holds_nothing_to_play_is_said(path: Path, tmp_path: Path, capsys: Any, channel: str) -> None:
    flags = ["-i", "hil-local", "-c", channel]
    assert main(["play", str(path), *flags, "--id", "0x7ff"]) == 2
    assert "no frame was chosen" in capsys.readouterr().err
    (tmp_path / "odd.xyz").write_text("?")
    for name in ("odd.xyz", "none.log"):
        assert main(["play", str(tmp_path / name), *flags]) == 2
    (tmp_path / "bad.blf").write_bytes(b"LOGG" + bytes(range(200)))
    (tmp_path / "bad.log").write_text("(1.0) can0 not a frame\n")
    for name in ("bad.blf", "bad.log"):
        with pytest.raises(LogError):
            list(chosen(Source(tmp_path / name), Choice()))


def test_keys_pause_step_and_go_on() -> None:
    ours, theirs = pty.openpty()
    try:
        import tty

        tty.setcbreak(theirs)
        keys, frame = Keys(theirs, paused=True), Played(0, 1, b"", False, False)
        os.write(ours, b"nn ")
        assert [keys(frame), keys(frame), keys.paused] == [True, True, True]
        assert keys(frame) and not keys.paused  # the space
        assert not keys(frame)
        os.write(ours, b" n")
        assert keys(frame) and keys.paused
    finally:
        os.close(ours)
        os.close(theirs)


def test_starting_paused_needs_a_terminal(path: Path, channel: str, capsys: Any) -> None:
    assert main(["play", str(path), "-i", "hil-local", "-c", channel, "--paused"]) == 2
    assert "needs a terminal" in capsys.readouterr().err


def with_others() -> Records:
    """The drive's frames, and an error frame of SYNC's class, one of COMMAND's, and a remote frame."""
    frames = FRAMES.copy()
    frames["can_id"][10], frames["can_id"][20] = 0x20000080, 0x20000201
    frames["can_id"][31], frames["received"][31] = 0x40000181, 1
    return frames


@pytest.mark.parametrize("ending", [".mcap", ".log", ".asc", ".blf", ".mf4"])
def test_error_and_remote_frames_are_never_played(tmp_path: Path, ending: str) -> None:
    frames = with_others()
    write_log(tmp_path / "run.mcap", some_ticks(100), frames)
    path = tmp_path / f"run{ending}"
    if ending != ".mcap":
        export(tmp_path / "run.mcap", path, frames=True)
    source = Source(path)
    found = [(frame.can_id, frame.data) for frame in source.frames()]
    data = frames[(frames["can_id"] & 0x60000000) == 0]
    assert found == [(int(f["can_id"]), bytes(f["data"][: f["size"]])) for f in data]
    assert source.left_out == {"error frames left out": 2, "remote frames left out": 1}


def test_what_was_left_out_is_said(tmp_path: Path, channel: str, capsys: Any) -> None:
    write_log(tmp_path / "run.mcap", some_ticks(100), with_others())
    words = ["play", str(tmp_path / "run.mcap"), "-i", "virtual", "-c", channel, "--rate", "100"]
    with can.Bus(interface="virtual", channel=channel) as bus:
        assert main([*words, "--direction", "both", "--json"]) == 0
        heard = []
        while (message := bus.recv(0.0)) is not None:
            heard.append(message)
    found = json.loads(capsys.readouterr().out)
    assert found["error frames left out"] == 2 and found["frames sent"] == len(heard) == 297
    assert not any(m.is_error_frame or m.is_remote_frame for m in heard)


STAMP = "(1795758784.904425)"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.log", f"{STAMP} can0 181#11\n{STAMP} can1 181#22\n", "name one with --recorded-channel"),
        ("a.log", f"{STAMP} can0 181#11\n{STAMP} can0 181#1\n", "1 of 2 lines can't be read"),
        ("a.log", "  can0  181   [1]  11\n", "what candump prints on the screen"),
        ("a.blf", "", "empty"),
        ("a.txt", "x", "a recording ends in one of"),
    ],
)
def test_a_recording_that_is_not_clear_is_refused_before_anything_is_sent(
    tmp_path: Path, channel: str, capsys: Any, name: str, text: str, said: str
) -> None:
    (tmp_path / name).write_text(text)
    words = ["play", str(tmp_path / name), "-i", "virtual", "-c", channel, "--direction", "both"]
    with can.Bus(interface="virtual", channel=channel) as bus:
        assert main(words) == 2
        assert bus.recv(0.0) is None
    err = capsys.readouterr().err
    assert said in err and len(err.strip().splitlines()) == 1


def test_one_channel_of_several_is_played_and_what_is_there_of_a_damaged_one(
    tmp_path: Path, channel: str, capsys: Any
) -> None:
    (tmp_path / "a.log").write_text(
        f"{STAMP} can0 181#11\n{STAMP} can1 181#22\n{STAMP} can1 xx\n{STAMP} can1 181#33\n"
    )
    words = ["play", str(tmp_path / "a.log"), "-i", "virtual", "-c", channel, "--recorded-channel", "can1"]
    with can.Bus(interface="virtual", channel=channel) as bus:
        assert main([*words, "--partial", "--json"]) == 0
        heard = [bytes(message.data) for message in (bus.recv(0.0), bus.recv(0.0)) if message]
    found = json.loads(capsys.readouterr().out)
    assert heard == [b"\x22", b"\x33"] and "1 of 4 lines" in found["log"]
