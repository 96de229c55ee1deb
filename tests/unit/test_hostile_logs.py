"""A stranger's log is refused or read with bounds; nothing of it commands terminal, kernel or file system."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import pytest
import zstandard
from mcap.records import Chunk
from websockets.datastructures import Headers
from websockets.http11 import Request

from hil.cli import main
from hil.control.law import N_MAX
from hil.control.observer import ADAPTIVE
from hil.log.container import encode
from hil.log.mcapfile import RunFile
from hil.log.reader import EVENT_TEXT_MOST, EVENTS_MOST, Log, open_log
from hil.log.schema import pack_event
from hil.replay import replay_log
from hil.replay.ranges import RANGES
from hil.watch import web
from tests.golden.kept import LOGS

pytestmark = pytest.mark.slow

SIMULATED = LOGS / "1a4c819" / "simulate.mcap"
PART = LOGS / "1a4c819" / "split.001.mcap"
ESCAPE = "\x1b]0;pwned\x07\x1b[2J[red]same[/red] [/x] <script>alert(1)</script>"


def named(log: Log) -> Log:
    """The log with its parameters and state by name, as another version's."""
    from hil.replay.machine import machine_of, restored, state_text

    machine = machine_of(log)
    log.attachments["controller.json"] = machine.to_json()
    if "state.json" in log.attachments:
        kept, k = restored(machine, log.attachments["state.json"])
        log.attachments["state.json"] = state_text(kept, k)
    return log


@pytest.mark.parametrize("value", [-1, 0, 257, 2**31, 2**62, 1e300, "inf", None, [1, 2]])
def test_a_counter_modulus_out_of_range_is_refused(value: object) -> None:
    for where in ("wire", "controller"):
        log = named(open_log(SIMULATED))
        if where == "wire":
            wire = json.loads(log.metadata["run"]["wire"]) | {"counter_modulus": value}
            log.metadata["run"]["wire"] = json.dumps(wire)
        else:
            given = json.loads(log.attachments["controller.json"])
            given["safety"]["counter_modulus"] = value
            log.attachments["controller.json"] = json.dumps(given)
        verdict = replay_log(log)
        assert verdict.verdict == "cannot" and "counter_modulus" in verdict.why, where


@pytest.mark.parametrize(
    ("record", "name"), [(record, name) for record, names in RANGES.items() for name in names]
)
def test_what_a_kernel_indexes_by_is_refused_out_of_its_range(record: str, name: str) -> None:
    file = "state.json" if record.endswith("state") else "controller.json"
    for value in (RANGES[record][name][0] - 1, RANGES[record][name][1] + 1, -(2**63), 2**63 - 1):
        log = named(open_log(PART))
        given = json.loads(log.attachments[file])
        old = given[record][name]
        given[record][name] = [value] * len(old) if isinstance(old, list) else value
        log.attachments[file] = json.dumps(given)
        verdict = replay_log(log)
        assert verdict.verdict == "cannot" and f"{record}.{name}" in verdict.why


@pytest.mark.parametrize(
    ("N", "short", "first", "said"),
    [(257, 20, 2, "have room for 256"), (40, 0, 0, "do not grow"), (40, 41, 2, "do not grow"),
     (40, 12, 13, "do not grow"), (40, 12, 0, "do not grow")],
)  # fmt: skip
def test_lengths_of_an_adaptive_window_that_can_not_be_are_refused(
    N: int, short: int, first: int, said: str
) -> None:
    log = named(open_log(PART))
    given = json.loads(log.attachments["controller.json"])
    for name, value in (("form", ADAPTIVE), ("shaped", 1), ("N", N), ("short", short), ("first", first)):
        given["law"][name] = [value] * 3 if name != "shaped" else value
    log.attachments["controller.json"] = json.dumps(given)
    verdict = replay_log(log)
    assert verdict.verdict == "cannot" and said in verdict.why


def test_state_of_another_length_is_refused() -> None:
    log = open_log(PART)
    kept = json.loads(log.attachments["state.json"])
    for name in ("safety_state", "law_state"):
        for text in ("", "00", kept[name][:-2], "zz", {"head": 1}, {"nothing": 1}, N_MAX):
            log.attachments["state.json"] = json.dumps(kept | {name: text})
            assert replay_log(log).verdict in ("cannot", "differs")


def event_bomb(path: Path, chunks: int) -> Path:
    """A small file of very many events."""
    data = pack_event(1, 1, "a" * 40, "b")
    with RunFile(path, {"metadata": {"kind": "test"}}) as file:
        message = struct.pack("<BQHIQQ", 5, 22 + len(data), file._channels["/event"], 0, 1, 1) + data
        raw = message * 60_000
        chunk = Chunk(
            compression="zstd",
            data=zstandard.ZstdCompressor(level=1).compress(raw),
            message_start_time=1,
            message_end_time=1,
            uncompressed_crc=zlib.crc32(raw),
            uncompressed_size=len(raw),
        )
        file._out._append(encode(chunk) * chunks)
        file.add_event(2, 2, "long", "x" * 100_000)
        file.finish({"ended": "stop_requested"})
    return path


def test_events_are_bounded(tmp_path: Path) -> None:
    path = event_bomb(tmp_path / "a.mcap", 3)
    log = open_log(path)
    assert path.stat().st_size < 200_000 and log.event_count == 180_001
    assert len(log.events) == EVENTS_MOST and "more than 100000 events" in (log.damage or "")
    log = open_log(event_bomb(tmp_path / "b.mcap", 0))
    assert log.damage is None and len(log.events[0]["text"]) == EVENT_TEXT_MOST


def evil(path: Path) -> Path:
    """A good log whose texts are markup and terminal sequences."""
    log = open_log(SIMULATED)
    run = log.metadata["run"] | {"kind": ESCAPE, "commit": ESCAPE}
    with RunFile(
        path, {"metadata": run, "attachments": log.attachments | {ESCAPE: ESCAPE}}, absent=log.absent
    ) as file:
        file.add_ticks(log.ticks)
        file.add_event(1, 1, ESCAPE, ESCAPE)
        file.finish({"ended": ESCAPE})
    return path


@pytest.mark.parametrize("words", [["info"], ["replay"], ["report"], ["recover"], ["export", "-o", "x.csv"]])
def test_markup_and_sequences_do_not_reach_the_terminal(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    name = "[/x][red]\x1b[2J.mcap"
    (tmp_path / name).parent.mkdir()
    evil(tmp_path / name)
    assert main([words[0], name, *words[1:]]) == 0
    shown = "".join(capsys.readouterr())
    assert "\x1b" not in shown and "\x07" not in shown
    if words[0] in ("replay", "recover", "report"):
        assert "[/x][red]" in shown.replace("\n", "")
    assert main([words[0], "[/y]\x1b[2J", *words[1:]]) == 2
    assert "\x1b" not in "".join(capsys.readouterr())


OUTPUTS = [
    ["replay", "LOG", "--junit", "OUT"],
    ["replay", "LOG", "--config", "configs/demo.toml", "-o", "OUT"],
    ["report", "LOG", "-o", "OUT"],
    ["export", "LOG", "-o", "OUT", "--force"],
    ["recover", "LOG", "-o", "OUT"],
    ["import", "LOG", "--config", "configs/demo.toml", "-o", "OUT", "--force"],
    ["faults", "--html", "OUT", "--only", "no fault"],
]


@pytest.mark.parametrize("words", OUTPUTS, ids=lambda words: words[0])
@pytest.mark.parametrize("name", ["other.mcap", "page.html", "v.xml", "t.csv", "notes.txt", "data"])
def test_no_output_is_written_over_a_log_or_another_kind(
    words: list[str], name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if words[0] == "import" and name == "other.mcap":
        return  # forced, and of its kind
    source, out = tmp_path / "log.mcap", tmp_path / name
    for path in (source, out):
        path.write_bytes(SIMULATED.read_bytes())
    before = out.read_bytes()
    given = [{"LOG": str(source), "OUT": str(out)}.get(word, word) for word in words]
    assert main(given) == 2, capsys.readouterr()
    lines = capsys.readouterr().err.strip().splitlines()
    assert out.read_bytes() == before and len(lines) == 1 and name in lines[0]


def test_junit_over_many_logs_leaves_them_all(tmp_path: Path) -> None:
    logs = [tmp_path / f"{number}.mcap" for number in range(3)]
    for path in logs:
        path.write_bytes(SIMULATED.read_bytes())
    assert main(["replay", "--junit", *map(str, logs)]) == 2
    assert all(path.read_bytes() == SIMULATED.read_bytes() for path in logs)


def test_of_two_host_headers_none_is_taken() -> None:
    headers = Headers([("Host", "a"), ("Host", "a")])
    assert web._only(Request("/", headers), "Host") == "a, a"
    assert web._only(Request("/", Headers([("Host", "a")])), "Host") == "a"
    assert web._only(Request("/", Headers()), "Host") is None
