"""Our logs as other programs rewrite them: another compression, no chunks, attachments and metadata last."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from hil.cli import main
from hil.log.parts import grouped
from hil.log.reader import open_log
from hil.replay import replay
from hil.report.collect import collect
from tests.conftest import CONFIGS
from tests.golden.kept import LOGS
from tests.logfiles import some_frames, some_ticks, write_log

GOLDEN = LOGS / "1a4c819" / "lockstep-fac.mcap"
NONE, LZ4, ZSTD = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD
VARIANTS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": ZSTD},
    "lz4": {"compression": LZ4},
    "none": {"compression": NONE},
    "small chunks": {"compression": LZ4, "chunk_size": 4096},
    "no chunks": {"use_chunking": False},
    "no index": {"compression": LZ4, "index_types": IndexType.NONE},
    "no summary": {
        "compression": LZ4,
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "use_summary_offsets": False,
        "repeat_channels": False,
        "repeat_schemas": False,
    },
    "no chunks, no index": {"use_chunking": False, "index_types": IndexType.NONE},
    "no checksums": {"compression": LZ4, "enable_crcs": False},
}


def rewrite(source: Path, out: Path, *, last: bool, **options: Any) -> Path:
    """``source`` through the mcap package; ``last``: attachments and metadata behind the messages."""
    with source.open("rb") as stream, out.open("wb") as raw:
        reader, writer = make_reader(stream), Writer(raw, **options)
        writer.start(library="a stranger's")

        def named() -> None:
            for one in reader.iter_attachments():
                writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
            for record in reader.iter_metadata():
                writer.add_metadata(record.name, record.metadata)

        if not last:
            named()
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            times = message.log_time, message.data, message.publish_time, message.sequence
            writer.add_message(channels[channel.id], *times)
        if last:
            named()
        writer.finish()
    return out


def said(words: list[str], capsys: Any) -> dict[str, Any]:
    assert main([*words, "--json"]) == 0, words
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.corners
@pytest.mark.parametrize("last", [False, True], ids=["first", "last"])
@pytest.mark.parametrize("variant", list(VARIANTS))
def test_a_rewritten_log_is_read_whole(variant: str, last: bool, tmp_path: Path, capsys: Any) -> None:
    path = rewrite(GOLDEN, tmp_path / "a.mcap", last=last, **VARIANTS[variant])
    own, log = open_log(GOLDEN), open_log(path)
    assert log.damage is None and log.ticks.tobytes() == own.ticks.tobytes()
    assert log.frames == own.frames and log.events == own.events
    assert (log.attachments, log.result, log.metadata) == (own.attachments, own.result, own.metadata)
    assert (verdict := replay(path)).verdict == "same" and verdict.ticks == len(own.ticks)
    found, at_home = said(["info", str(path)], capsys), said(["info", str(GOLDEN)], capsys)
    same = ("run", "result", "attachments", "damage", "written_by")
    assert {name: found[name] for name in same} == {name: at_home[name] for name in same}
    assert found["counts"]["/tick"] == len(own.ticks) == at_home["counts"]["/tick"]
    out = tmp_path / "b.mcap"
    assert said(["recover", str(path), "-o", str(out)], capsys)["ticks"] == len(own.ticks)
    assert open_log(out).ticks.tobytes() == own.ticks.tobytes() and replay(out).verdict == "same"
    assert said(["export", str(path), "-o", str(tmp_path / "a.csv")], capsys)["records"] == len(own.ticks)


@pytest.mark.parametrize("variant", ["lz4", "no chunks", "no summary"])
def test_a_report_finds_the_config_behind_the_messages(variant: str, tmp_path: Path) -> None:
    run = collect(rewrite(GOLDEN, tmp_path / "a.mcap", last=True, **VARIANTS[variant]))
    assert run.config is not None and run.config_problem == "" and run.verdict.verdict == "same"


@pytest.mark.parametrize("variant", ["lz4", "no chunks", "no summary"])
def test_parts_are_known_by_metadata_behind_the_messages(variant: str, tmp_path: Path) -> None:
    parts = sorted(LOGS.glob("1a4c819/split.*.mcap"))
    paths = [
        rewrite(part, tmp_path / f"{name}.mcap", last=True, **VARIANTS[variant])
        for part, name in zip(parts, ("z", "a"), strict=True)
    ]
    (group,) = grouped([paths[1], paths[0]])
    assert list(group) == paths and replay(group).verdict == replay(parts).verdict == "same"
    assert replay(paths[1]).verdict == "same"  # by the state at its first tick


def test_without_chunks_a_log_cut_off_is_good_up_to_there(tmp_path: Path) -> None:
    path = rewrite(GOLDEN, tmp_path / "a.mcap", last=False, use_chunking=False)
    raw, own = path.read_bytes(), open_log(GOLDEN).ticks
    (tmp_path / "cut.mcap").write_bytes(raw[: len(raw) // 2])
    log = open_log(tmp_path / "cut.mcap")
    assert log.damage is not None and 0 < len(log.ticks) < len(own)
    assert log.ticks.tobytes() == own[: len(log.ticks)].tobytes()


@pytest.mark.parametrize("words", [["info"], ["replay"], ["report"], ["recover"], ["export"]])
def test_a_compression_that_is_not_known_is_refused(words: list[str], tmp_path: Path, capsys: Any) -> None:
    path = rewrite(GOLDEN, tmp_path / "a.mcap", last=False, compression=LZ4, index_types=IndexType.NONE)
    path.write_bytes(path.read_bytes().replace(b"\x03\x00\x00\x00lz4", b"\x03\x00\x00\x00lzo"))
    out = {"export": ["-o", str(tmp_path / "b.csv")]}.get(words[0], [])
    assert main([*words, str(path), *out]) != 0
    said = capsys.readouterr()
    assert "compression 'lzo' is not known here" in said.out + said.err
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]


def test_recover_refuses_a_log_of_which_nothing_is_left(tmp_path: Path, capsys: Any) -> None:
    write_log(path := tmp_path / "a.mcap", some_ticks(100), some_frames(50))
    raw = path.read_bytes()
    path.write_bytes(raw[: raw.index(b"zstd") - 60])
    assert main(["recover", str(path)]) == 2
    assert "holds no tick, frame or event that can be read" in capsys.readouterr().err
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_our_own_logs_come_in_both_compressions(compression: str, tmp_path: Path) -> None:
    from hil.log.mcapfile import RunFile

    ticks = some_ticks(100)
    with RunFile(tmp_path / "a.mcap", {"metadata": {}, "compression": compression}) as file:
        file.add_ticks(ticks)
        file.finish({"ended": "stop_requested"})
    with (tmp_path / "a.mcap").open("rb") as stream:
        found = make_reader(stream)
        summary = found.get_summary()
        assert summary is not None and [c.compression for c in summary.chunk_indexes] == [compression]
        assert sum(1 for _ in found.iter_messages(["/tick"])) == 100
    assert open_log(tmp_path / "a.mcap").ticks["k"].tolist() == ticks["k"].tolist()


def test_an_lz4_bomb_is_cut_short(tmp_path: Path) -> None:
    import lz4.frame
    from mcap.records import Chunk

    from hil.log.errors import DamagedError
    from hil.log.scan import chunk_content

    data = lz4.frame.compress(bytes(64 << 20), store_size=False)
    with pytest.raises(DamagedError, match="another size"):
        chunk_content(Chunk("lz4", data, 0, 0, 0, 1000))
    with pytest.raises(DamagedError, match="can't be decompressed"):
        chunk_content(Chunk("lz4", b"no frame at all", 0, 0, 0, 1000))


def test_lz4_is_asked_for_in_the_config(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    words = ["simulate", str(CONFIGS / "demo.toml"), "--duration", "0.05"]
    settings = ('log.compression="lz4"', f'log.folder="{tmp_path}"', 'log.name="a"')
    assert main([*words, *(word for one in settings for word in ("--set", one))]) == 0
    with out.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and {c.compression for c in summary.chunk_indexes} == {"lz4"}
    assert replay(out).verdict == "same"
