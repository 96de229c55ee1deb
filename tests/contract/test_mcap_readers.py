"""Our files in other people's readers: the mcap package with mcap-protobuf-support."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import MessageIndex
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from hil.log.mcapfile import RunFile
from hil.log.records import EVENT_BYTES
from hil.log.ring import Ring
from hil.log.schema import FRAME
from hil.log.writer import Drain
from hil.signals import FIELDS, TICK
from tests.logfiles import HEADER, some_frames, some_ticks, write_log

TICKS, FRAMES = some_ticks(300), some_frames(900)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_log(tmp_path / "run.mcap", TICKS, FRAMES)
    return tmp_path / "run.mcap"


def test_ticks_have_named_fields_with_the_logged_values(path: Path) -> None:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        seen = list(reader.iter_decoded_messages(topics=["/tick"]))
    assert len(seen) == len(TICKS)
    for logged, (schema, _, message, tick) in zip(TICKS, seen, strict=True):
        assert schema is not None and schema.name == "hil.Tick"
        assert message.log_time == message.publish_time == logged["t_ns"] and message.sequence == logged["k"]
        assert all(getattr(tick, field.name) == logged[field.name] for field in FIELDS)


def test_units_stand_in_the_metadata(path: Path) -> None:
    with path.open("rb") as stream:
        metadata = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    assert metadata["units"]["T_L_hat"] == "N m" and metadata["run"]["clock"] == "lockstep"


def test_frames_events_and_statistics_decode(path: Path) -> None:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        by_topic: dict[str, list[object]] = {}
        for _, channel, _, message in reader.iter_decoded_messages():
            by_topic.setdefault(channel.topic, []).append(message)
    frames = [(m.can_id, m.data) for topic in ("/can/rx", "/can/tx") for m in by_topic[topic]]  # type: ignore[attr-defined]
    assert sorted(frames) == sorted((int(f["can_id"]), bytes(f["data"][: f["size"]])) for f in FRAMES)
    assert len(by_topic["/event"]) == len(by_topic["/stats"]) == 6


def test_no_statistics_are_stamped_before_the_first_tick(tmp_path: Path) -> None:
    """A viewer's time line begins where the run does, however long the start took."""
    sizes = {"ticks": TICK.itemsize, "frames": FRAME.itemsize, "events": EVENT_BYTES}
    ticks, frames, events = (Ring.create(name, size, 16) for name, size in sizes.items())
    first = TICKS[100:101]
    with RunFile(tmp_path / "a.mcap", HEADER) as file:
        drain = Drain((ticks, frames, events), file, {})
        drain.once()
        drain.stats()
        ticks.push(first.tobytes())
        drain.once(final=True)
        drain.stats()
        file.finish({})
    for ring in (ticks, frames, events):
        ring.close()
    with (tmp_path / "a.mcap").open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages(["/stats"])]
    assert times == [first["t_ns"][0]]


def test_a_time_window_is_found_by_the_index(path: Path) -> None:
    with path.open("rb") as stream:
        window = make_reader(stream).iter_messages(
            ["/tick"], starting_at=100_000_000, ending_before=110_000_000
        )
        assert [message.sequence for _, _, message in window] == list(range(100, 110))


def test_every_checksum_holds_and_the_summary_counts(path: Path) -> None:
    with path.open("rb") as stream:
        assert sum(1 for _ in StreamReader(stream, validate_crcs=True).records) > len(TICKS)
    with path.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert summary is not None and summary.statistics is not None
    statistics = summary.statistics
    assert statistics.message_count == len(TICKS) + len(FRAMES) + 12
    assert statistics.chunk_count == len(summary.chunk_indexes) == 12
    assert (statistics.message_start_time, statistics.message_end_time) == (0, 299_000_000)


def test_the_chunk_index_points_at_message_indexes(path: Path) -> None:
    raw = path.read_bytes()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for chunk in summary.chunk_indexes:
        for channel, at in chunk.message_index_offsets.items():
            assert raw[at] == 7 and int.from_bytes(raw[at + 9 : at + 11], "little") == channel


def test_attachments_come_back(path: Path) -> None:
    with path.open("rb") as stream:
        found = {record.name: record.data.decode() for record in make_reader(stream).iter_attachments()}
    assert found == HEADER["attachments"]


def test_the_index_holds_the_logged_times_when_the_caller_fills_his_array_again(tmp_path: Path) -> None:
    ticks, half = some_ticks(200), some_ticks(100)
    with RunFile(tmp_path / "a.mcap", HEADER, chunk_bytes=150 * 1024) as file:
        for at in (0, 100):
            half[:] = ticks[at : at + 100]  # as hil simulate does, block after block
            file.add_ticks(half)
        file.finish({"ended": "stop_requested"})
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        spans = [(c.message_start_time, c.message_end_time) for c in summary.chunk_indexes]
        assert min(spans)[0] == ticks["t_ns"][0] and max(spans)[1] == ticks["t_ns"][-1]
        for chunk in summary.chunk_indexes:
            (at,) = chunk.message_index_offsets.values()
            stream.seek(at)
            index = next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
            assert isinstance(index, MessageIndex)
            times = [t for t, _ in sorted(index.records, key=lambda entry: entry[1])]
            assert times == sorted(set(times)) and len(times) == len(index.records)
