"""Reading back: whole, cut off anywhere, damaged, hostile, foreign, recovered."""

from __future__ import annotations

import io
import json
import random
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import Writer

from hil.log import container
from hil.log.container import Block, Container, encode
from hil.log.errors import LogError
from hil.log.info import info
from hil.log.mcapfile import TICK_MESSAGE, RunFile
from hil.log.reader import Log, open_log, read_blocks
from hil.log.recover import recover
from hil.log.scan import MAX_CHUNK
from hil.log.schema import file_descriptor_set
from hil.signals import TICK, new_ticks
from tests.logfiles import HEADER, some_frames, some_ticks, write_log

pytestmark = pytest.mark.slow

TICKS, FRAMES, BLOCK = some_ticks(500), some_frames(2000), 50


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    write_log(path, TICKS, FRAMES, block=BLOCK)
    return path.read_bytes()


def saved(tmp_path: Path, raw: bytes) -> Path:
    path = tmp_path / "run.mcap"
    path.write_bytes(raw)
    return path


def test_everything_comes_back(tmp_path: Path, whole: bytes) -> None:
    log = open_log(saved(tmp_path, whole))
    assert log.damage is None and log.gaps == [] and log.bytes_lost == 0
    assert log.ticks.tobytes() == TICKS.tobytes()
    expected = sorted(
        (bool(f["received"]), int(f["t_ns"]), int(f["can_id"]), bytes(f["data"][: f["size"]])) for f in FRAMES
    )
    assert sorted(log.frames) == expected
    assert [event["k"] for event in log.events] == list(range(0, 500, BLOCK))
    assert log.events[1]["text"] == "ticks from 50 on" and log.events[1]["kind"] == "block"
    assert log.attachments == HEADER["attachments"]
    assert log.metadata["run"] == {"kind": "test", "clock": "lockstep", "seed": "7"}
    assert log.metadata["units"]["w"] == "rad/s" and log.metadata["meanings"]["k"] == "tick index"
    assert log.result == {"ended": "stop_requested", "ticks": 500}
    assert open_log(saved(tmp_path, whole), frames=False).frames == []


def test_a_file_cut_off_anywhere_reads_up_to_there(tmp_path: Path, whole: bytes) -> None:
    """Never another exception than 'no log of hil', and that only inside the first record."""
    rng = random.Random(5)
    header = 9 + struct.unpack_from("<Q", whole, 9)[0] + 8
    cuts = [*range(0, header + 3), *(rng.randrange(header, len(whole)) for _ in range(200)), len(whole) - 1]
    last = -1
    for cut in sorted(cuts):
        path = saved(tmp_path, whole[:cut])
        if cut < header:
            with pytest.raises(LogError, match="no log of hil"):
                open_log(path)
            continue
        log = open_log(path)
        assert log.damage is not None, f"cut at {cut}"
        assert log.ticks.tobytes() == TICKS[: len(log.ticks)].tobytes(), f"cut at {cut}"
        assert len(log.ticks) % BLOCK == 0 and len(log.ticks) >= last, f"cut at {cut}"
        assert f"{len(log.ticks)} ticks are good" in log.damage
        last = len(log.ticks)
    assert last == len(TICKS)
    assert "the summary is missing" in (open_log(saved(tmp_path, whole[:-60])).damage or "")


def test_a_flipped_byte_costs_at_most_its_chunk(tmp_path: Path, whole: bytes) -> None:
    rng = random.Random(6)
    for _ in range(150):
        at = rng.randrange(60, len(whole))
        raw = bytearray(whole)
        raw[at] ^= 1 << rng.randrange(8)
        try:
            log = open_log(saved(tmp_path, bytes(raw)))
        except LogError:
            continue
        good = log.ticks["k"].astype(int)
        assert log.ticks.tobytes() == TICKS[good].tobytes(), (
            f"flipped in byte {at}: a wrong value was believed"
        )
        if len(good) < len(TICKS):
            assert log.damage is not None, f"flipped in byte {at}"


def chunk_places(raw: bytes) -> list[tuple[int, int]]:
    """(begin, length with head) of each chunk."""
    at, out = 8, []
    while raw[at] != 2:
        length = 9 + struct.unpack_from("<Q", raw, at + 1)[0]
        if raw[at] == 6:
            out.append((at, length))
        at += length
    return out


def test_reading_goes_on_behind_a_damaged_chunk(tmp_path: Path, whole: bytes) -> None:
    at, length = chunk_places(whole)[4]
    raw = bytearray(whole)
    raw[at + length - 20] ^= 0xFF
    log = open_log(saved(tmp_path, bytes(raw)))
    assert log.damage is not None and f"at byte {at}" in log.damage and "missing" not in log.damage
    assert len(log.ticks) == 450 and log.gaps == [(150, 50)] and log.bytes_lost > 0
    assert log.result["ended"] == "stop_requested"


def test_an_overlooked_chunk_is_noticed(tmp_path: Path, whole: bytes) -> None:
    """Its opcode flipped, a chunk looks like a record of no interest; the summary's count knows better."""
    raw = bytearray(whole)
    raw[chunk_places(whole)[2][0]] = 0x7F
    log = open_log(saved(tmp_path, bytes(raw)))
    assert log.damage is not None and "summary counts" in log.damage and log.gaps == [(100, 50)]


def test_a_renamed_topic_is_noticed(tmp_path: Path, whole: bytes) -> None:
    at = whole.index(b"/tick")
    log = open_log(saved(tmp_path, whole[:at] + b"/tock" + whole[at + 5 :]))
    assert len(log.ticks) == 0 and "two topics" in (log.damage or "")


def test_dropped_records_are_gaps_and_skipped_periods_are_not(tmp_path: Path) -> None:
    ticks = some_ticks(100)[np.r_[0:20, 25:60, 63:100]]
    ticks["gap"][55] = 4
    path = tmp_path / "run.mcap"
    write_log(path, ticks, FRAMES[:0])
    assert open_log(path).gaps == [(25, 5)]


def test_blocks_are_bounded_whatever_the_length(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RunFile(path, HEADER) as file:
        file.add_ticks(some_ticks(20_000))
        file.finish({})
    sizes = [len(block.records) for block in read_blocks(Log(path, new_ticks(0)))]
    assert sum(sizes) == 20_000 and max(sizes) * TICK_MESSAGE.itemsize <= 256 * 1024


def test_ticks_and_frames_mixed_in_one_chunk_are_read_too(tmp_path: Path) -> None:
    """As other programs arrange them: here the mcap package's own writer, schemas inside the chunks."""
    path, descriptors = tmp_path / "run.mcap", file_descriptor_set().SerializeToString()
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=10_000)
        writer.start(library="hil-drive")
        ids = {}
        for topic, name in (("/tick", "hil.Tick"), ("/foreign", "hil.Event")):
            schema = writer.register_schema(name, "protobuf", descriptors)
            ids[topic] = writer.register_channel(topic, "protobuf", schema)
        writer.add_metadata("run", {})
        for tick in TICKS:
            writer.add_message(ids["/tick"], int(tick["t_ns"]), tick.tobytes(), 0)
            writer.add_message(ids["/foreign"], int(tick["t_ns"]), b"whatever", 0)
        writer.finish()
    log = open_log(path)
    assert log.damage is None and log.ticks.tobytes() == TICKS.tobytes()


def hostile(path: Path, chunk: Chunk) -> Path:
    """A log whose only chunk is ``chunk``."""
    with RunFile(path, HEADER) as file:
        file._out._append(encode(chunk))
    return path


def bomb(claimed: int, real: int) -> Chunk:
    data = zstandard.ZstdCompressor(write_content_size=True).compress(bytes(real))
    return Chunk("zstd", data, 0, 0, 0, claimed)


@pytest.mark.parametrize(
    ("chunk", "why"),
    [
        (bomb(100 << 30, 1000), "claims"),
        (bomb(1000, MAX_CHUNK * 4), "another size"),
        (bomb(2000, 1000), "another size"),
        (Chunk("zstd", b"no zstd at all", 0, 0, 0, 100), "decompressed"),
        (Chunk("", bytes(8), 0, 0, 0, 8), "inside a record"),
        (Chunk("", struct.pack("<BQ", 5, 1 << 60), 0, 0, 0, 9), "runs over"),
        (Chunk("", struct.pack("<BQ", 5, 0), 0, 0, 0, 9), "too short"),
        (Chunk("", b"abcdefgh" * 4, 0, 0, zlib.crc32(b"other"), 32), "checksum"),
    ],
)
def test_hostile_chunks_are_named_and_left_out(tmp_path: Path, chunk: Chunk, why: str) -> None:
    log = open_log(hostile(tmp_path / "run.mcap", chunk))
    assert log.damage is not None and why in log.damage and len(log.ticks) == 0


def test_a_bomb_that_names_its_size_is_never_unpacked(tmp_path: Path) -> None:
    path = hostile(tmp_path / "run.mcap", bomb(1000, MAX_CHUNK * 2))
    tracemalloc.start()
    try:
        open_log(path)
        assert tracemalloc.get_traced_memory()[1] < MAX_CHUNK
    finally:
        tracemalloc.stop()


def test_a_damaged_attachment_is_named_and_left_out(tmp_path: Path, whole: bytes) -> None:
    at = whole.index(b"rate_hz = 1000")
    log = open_log(saved(tmp_path, whole[:at] + b"R" + whole[at + 1 :]))
    assert "config.toml" not in log.attachments and "config.toml" in (log.damage or "")
    assert len(log.ticks) == 500


@pytest.mark.parametrize("claimed", [1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
def test_an_attachment_of_a_claimed_length_is_not_allocated(
    tmp_path: Path, whole: bytes, claimed: int
) -> None:
    """Found by coverage-guided fuzzing: a length that is no index ended in an OverflowError."""
    size = whole.index(b"text/plain") + len(b"text/plain")
    log = open_log(saved(tmp_path, whole[:size] + claimed.to_bytes(8, "little") + whole[size + 8 :]))
    assert "config.toml" not in log.attachments and "attachment" in (log.damage or "")
    assert len(log.ticks) == 500


def test_ticks_are_joined_across_slabs(tmp_path: Path, whole: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.log.reader.SLAB_TICKS", 64)
    assert open_log(saved(tmp_path, whole)).ticks.tobytes() == TICKS.tobytes()


def test_a_bomb_without_its_size_is_cut_short(tmp_path: Path) -> None:
    data = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(MAX_CHUNK * 8))
    log = open_log(hostile(tmp_path / "run.mcap", Chunk("zstd", data, 0, 0, 0, 1000)))
    assert log.damage is not None and "decompressed" in log.damage


def test_a_record_that_claims_more_than_the_file_is_not_allocated(tmp_path: Path, whole: bytes) -> None:
    at = chunk_places(whole)[0][0]
    raw = whole[:at] + struct.pack("<BQ", 6, 100 << 30) + whole[at + 9 :]
    assert "runs over the end" in (open_log(saved(tmp_path, raw)).damage or "")


def test_ticks_with_foreign_tags_are_not_believed(tmp_path: Path) -> None:
    ticks = some_ticks(10)
    ticks["_18"] = b"\x01\x02"
    path = tmp_path / "run.mcap"
    write_log(path, ticks, FRAMES[:0])
    log = open_log(path)
    assert len(log.ticks) == 0 and log.damage is not None and "tags" in log.damage


def foreign(path: Path, schema_name: str, descriptors: bytes, data: bytes) -> Path:
    """A file with one message on /tick, by Container alone."""
    out = Container(path)
    channel = out.add_channel("/tick", out.add_schema(schema_name, descriptors))
    out.add_metadata("run", {})
    block = Block()
    one = np.array([1], np.int64)
    raw = struct.pack("<BQHIQQ", 5, 22 + len(data), channel, 0, 0, 0) + data
    block.add(one * channel, one, one * len(raw), raw)
    out.add_chunk(block)
    out.finish()
    return path


def test_other_schemas_versions_and_lengths_are_refused(tmp_path: Path) -> None:
    own = file_descriptor_set()
    with pytest.raises(LogError, match="another length"):
        open_log(foreign(tmp_path / "1", "hil.Tick", own.SerializeToString(), bytes(TICK.itemsize - 1)))
    with pytest.raises(LogError, match="not the schema"):
        open_log(foreign(tmp_path / "2", "other.Tick", own.SerializeToString(), bytes(TICK.itemsize)))
    own.file[0].message_type[0].field[0].name = "other"
    with pytest.raises(LogError, match="another version"):
        open_log(foreign(tmp_path / "3", "hil.Tick", own.SerializeToString(), bytes(TICK.itemsize)))


@pytest.mark.parametrize("content", [b"", b"MCAP", bytes(1000), container.MAGIC, b"k,w\n0,1.5\n" * 100])
def test_what_is_no_log_is_refused(tmp_path: Path, content: bytes) -> None:
    path = saved(tmp_path, content)
    for read in (open_log, info):
        with pytest.raises(LogError, match="no log of hil"):
            read(path)


def test_a_foreign_mcap_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(library="other")
        writer.finish()
    with pytest.raises(LogError, match="no log of hil"):
        open_log(path)


def test_a_missing_file_or_a_folder_is_refused(tmp_path: Path) -> None:
    for read in (open_log, info):
        for path in (tmp_path / "none.mcap", tmp_path):
            with pytest.raises(LogError, match="no such file"):
                read(path)


def test_ticks_that_memory_can_not_hold_are_refused(
    tmp_path: Path, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.log.reader.MEMORY_SHARE", 1e-12)
    with pytest.raises(LogError, match="block by block"):
        open_log(saved(tmp_path, whole))


def test_info_reads_the_summary(tmp_path: Path, whole: bytes) -> None:
    found = info(saved(tmp_path, whole))
    rx = int((FRAMES["received"] == 1).sum())
    assert found.counts == {"/tick": 500, "/can/rx": rx, "/can/tx": 2000 - rx, "/event": 10, "/stats": 10}
    assert (found.start_ns, found.end_ns, found.damage) == (0, 499_750_000, None)
    assert found.attachments == {name: len(text) for name, text in HEADER["attachments"].items()}
    assert json.loads(found.metadata["result"]["result"])["ended"] == "stop_requested"
    assert json.dumps(found.as_dict())


class Counting(io.FileIO):
    """A file that counts the bytes that are read from it."""

    taken = 0

    def readinto(self, buffer: Any) -> int:
        got = super().readinto(buffer)
        self.taken += got
        return got


def taken_by_info(path: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """Bytes that `info` reads of a file."""
    file = Counting(path)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda *_: io.BufferedReader(file, 512))
        assert info(path).damage is None
    return file.taken


def test_info_reads_as_much_of_a_long_log_as_of_a_short_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short, long = tmp_path / "short.mcap", tmp_path / "long.mcap"
    write_log(short, TICKS[:10], FRAMES[:40], block=1)
    write_log(long, some_ticks(4000), some_frames(16000), block=1)
    assert long.stat().st_size > 100 * short.stat().st_size
    assert info(long).counts["/tick"] == 4000
    least, most = (taken_by_info(path, monkeypatch) for path in (short, long))
    assert 0 < most <= least + 4 * 512  # where buffers begin


def test_info_waits_for_neither_compiler_nor_bus(tmp_path: Path, whole: bytes) -> None:
    script = "import sys; from hil.cli import main; main(sys.argv[1:]); print(*sys.modules, file=sys.stderr)"
    words = (sys.executable, "-c", script, "info", str(saved(tmp_path, whole)))
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    assert "stop_requested" in done.stdout
    loaded = set(done.stderr.split())
    assert "hil.log.info" in loaded and not loaded & {"numba", "scipy", "can", "cantools", "pandas"}


def test_info_reads_a_summary_without_offsets(tmp_path: Path, whole: bytes) -> None:
    at = len(whole) - len(container.MAGIC) - 20 + 8  # of the footer: where the offsets begin
    found = info(saved(tmp_path, whole[:at] + bytes(8) + whole[at + 8 :]))
    assert found.counts["/tick"] == 500 and found.damage is None


def test_info_of_a_cut_off_log_counts_what_is_there(tmp_path: Path, whole: bytes) -> None:
    found = info(saved(tmp_path, whole[: chunk_places(whole)[6][0]]))
    assert found.counts["/tick"] == 150 and found.end_ns == 149_000_000
    assert found.damage is not None


def test_info_counts_itself_what_the_summary_does_not(tmp_path: Path, whole: bytes) -> None:
    """A writer may leave the statistics out; what is not counted is not 0."""
    footer = len(whole) - len(container.MAGIC) - 20
    raw, at = bytearray(whole), struct.unpack_from("<Q", whole, footer)[0]
    raw[footer + 8 : footer + 16] = bytes(8)  # no offsets: the summary is read record by record
    while raw[at] != Opcode.STATISTICS:
        at += 9 + struct.unpack_from("<Q", raw, at + 1)[0]
    raw[at] = 0x7E
    assert info(saved(tmp_path, bytes(raw))).counts["/tick"] == 500


def test_info_survives_any_flipped_byte_in_the_summary(tmp_path: Path, whole: bytes) -> None:
    start = sum(chunk_places(whole)[-1])
    rng = random.Random(8)
    for _ in range(150):
        raw = bytearray(whole)
        raw[rng.randrange(start, len(raw))] ^= 1 << rng.randrange(8)
        try:
            info(saved(tmp_path, bytes(raw)))
        except LogError as error:
            assert "no log of hil" in str(error)


def test_recover_makes_a_complete_log_and_says_what_is_missing(tmp_path: Path, whole: bytes) -> None:
    cut = saved(tmp_path, whole[: chunk_places(whole)[7][0] + 100])
    recovery = recover(cut, tmp_path / "out.mcap")
    assert recovery.damage is not None and recovery.ticks == 200 and recovery.last_t_ns == 199_000_000
    log = open_log(tmp_path / "out.mcap")
    assert log.damage is None and log.ticks.tobytes() == TICKS[:200].tobytes()
    assert len(log.frames) == recovery.frames >= 600 and len(log.events) == recovery.events >= 3
    assert log.attachments == HEADER["attachments"] and log.metadata["recovered"]["from"] == "run.mcap"
    assert "result is missing" in log.metadata["recovered"]["damage"]
    assert "recovered" in log.result["ended"]


def test_recover_never_overwrites(tmp_path: Path, whole: bytes) -> None:
    path = saved(tmp_path, whole)
    with pytest.raises(LogError, match="exists"):
        recover(path, path)
    assert path.read_bytes() == whole


def test_leaving_by_an_exception_leaves_a_complete_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(ZeroDivisionError), RunFile(path, HEADER) as file:
        file.add_ticks(TICKS)
        raise ZeroDivisionError("seen")
    log = open_log(path)
    assert log.damage is None and log.result["ended"] == "ZeroDivisionError: seen"
    assert path.stat().st_mode & 0o777 == 0o600
