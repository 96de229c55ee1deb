"""Replay sees every bit: one that changed in a tick or a received frame is found, tick and field named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.log.check import first_broken, seal, sums
from hil.log.mcapfile import RunFile
from hil.log.reader import Log, open_log
from hil.log.schema import Records
from hil.replay import replay, replay_log
from hil.replay.frames import FrameCheck
from hil.replay.run import frame_records
from hil.runtime.setup import Overrides, load_setup
from hil.signals import FIELDS, RxFlag, TickArray, new_ticks
from hil.sim.simulate import simulate
from tests.conftest import CONFIGS
from tests.golden.kept import LOGS
from tests.logfiles import some_ticks

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bits")
    settings = (f'log.folder="{folder}"', "loop.duration_s=1.0")
    return Path(simulate(load_setup(CONFIGS / "demo.toml", Overrides(settings=settings)), [])["log"])


def flipped(ticks: TickArray, row: int, name: str, bit: int) -> TickArray:
    """A copy with one bit of one field turned over."""
    out = ticks.copy()
    out.view(np.uint8).reshape(len(out), -1)[row, out.dtype.fields[name][1] + bit // 8] ^= 1 << bit % 8
    return out


def rewritten(path: Path, log: Log, ticks: TickArray) -> Path:
    """The log written anew with other ticks, as any program may that uses our writer."""
    path.unlink(missing_ok=True)
    with RunFile(path, {"metadata": log.metadata["run"], "attachments": log.attachments}) as file:
        file.add_ticks(ticks)
        file.finish(log.result)
    return path


def test_600_of_600_bits_of_currents_are_found_without_frames(simulated: Path, tmp_path: Path) -> None:
    log, rng = open_log(simulated), np.random.default_rng(600)
    whole = log.ticks
    for number in range(600):
        row, name, bit = int(rng.integers(len(whole))), str(rng.choice(["i_q", "i_d"])), int(rng.integers(64))
        log.ticks = flipped(whole, row, name, bit)
        found = first_broken(log.ticks, log.absent)
        assert found is not None and (found.row, found.field) == (row, name), (row, name, bit)
        if number % 60 == 0:
            for verdict in (replay_log(log), replay(rewritten(tmp_path / "a.mcap", log, log.ticks))):
                first = verdict.first_difference
                assert first is not None and (first.tick, first.field) == (row, name), verdict


@pytest.mark.parametrize("name", [f.name for f in FIELDS])
def test_a_bit_of_any_field_is_found_and_placed(name: str) -> None:
    ticks = some_ticks(30)
    ticks["check"] = 0
    seal(ticks)
    bit = 8 * ticks.dtype[name].itemsize - 1
    for at in (0, 1, bit):
        found = first_broken(flipped(ticks, 17, name, at), frozenset())
        assert found is not None and (found.row, found.field) == (17, name)
        assert found.written == ticks[name][17] or name == "check"


def test_negative_zero_is_not_zero() -> None:
    ticks = new_ticks(3)
    seal(ticks)
    ticks["i_d"][1] = -0.0
    found = first_broken(ticks, frozenset())
    assert found is not None and found.field == "i_d" and str(found.logged) == "-0.0"


def test_several_changed_fields_are_found_too() -> None:
    ticks = some_ticks(30)
    ticks["check"] = 0
    seal(ticks)
    ticks["w"][3], ticks["u_q"][3] = 1.25, 2.5
    found = first_broken(ticks, frozenset())
    assert found is not None and found.row == 3 and found.field == "check"


def test_the_check_is_the_sum_that_the_page_says() -> None:
    ticks = some_ticks(2)
    total = 0

    def odd(seed: int) -> int:
        z = seed * 0x9E3779B97F4A7C15 % 2**64
        z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 % 2**64
        z = (z ^ z >> 27) * 0x94D049BB133111EB % 2**64
        return (z ^ z >> 31) | 1

    for field in FIELDS:
        if field.name != "check":
            high, low = divmod(int.from_bytes(ticks[field.name][:1].tobytes(), "little"), 2**32)
            total += low * odd(2 * field.number) + high * odd(2 * field.number + 1)
    assert int(sums(ticks)[0]) == total % 2**64


def test_a_record_keeps_its_check_and_gets_one_where_it_has_none() -> None:
    ticks = some_ticks(4)
    ticks["check"] = [5, 0, 0, 7]
    expected = sums(ticks)
    seal(ticks)
    assert ticks["check"].tolist() == [5, int(expected[1]), int(expected[2]), 7]


@pytest.fixture(scope="module")
def on_the_bus() -> Log:
    return open_log(LOGS / "1a4c819" / "lockstep.mcap")


def checked(log: Log, ticks: TickArray, frames: Records) -> FrameCheck:
    """What the frames say of the ticks."""
    check = FrameCheck(log)
    check.feed("ticks", ticks)
    check.feed("frames", frames)
    check.finish()
    assert check.note == ""
    return check


@pytest.mark.parametrize("name", ["lockstep", "lockstep-fac", "fault", "inverter"])
def test_the_frames_of_a_run_give_its_ticks(name: str) -> None:
    log = open_log(LOGS / "1a4c819" / f"{name}.mcap")
    check = checked(log, log.ticks, frame_records(log.frames))
    assert check.difference is None and check.done_k == int(log.ticks["k"][-1])


def test_every_bit_of_a_current_is_found_by_its_frame_in_a_log_of_format_1(on_the_bus: Log) -> None:
    frames, rng = frame_records(on_the_bus.frames), np.random.default_rng(601)
    for _ in range(100):  # 600 of 600 were tried
        row, bit = int(rng.integers(1, len(on_the_bus.ticks))), int(rng.integers(64))
        name = str(rng.choice(["i_q", "i_d"]))
        first = checked(on_the_bus, flipped(on_the_bus.ticks, row, name, bit), frames).difference
        assert first is not None and (first.tick, first.field) == (row, name), (row, name, bit)


def test_a_bit_of_a_received_payload_is_found(on_the_bus: Log) -> None:
    frames, rng = frame_records(on_the_bus.frames), np.random.default_rng(602)
    measured = np.nonzero((frames["received"] == 1) & np.isin(frames["can_id"], [0x181, 0x281]))[0]
    first_ns = int(on_the_bus.ticks["t_ns"][1])
    stamps, last_ns = frames["t_ns"][measured], int(on_the_bus.ticks["t_ns"][-1])
    measured = measured[(stamps > first_ns) & (stamps < last_ns)]
    for at in rng.choice(measured, 60):
        changed = frames.copy()
        byte, bit = int(rng.integers(changed["size"][at])), int(rng.integers(8))
        changed["data"][at, byte] ^= 1 << bit
        first = checked(on_the_bus, on_the_bus.ticks, changed).difference
        assert first is not None, (int(at), byte, bit)


def test_a_bit_of_a_sent_payload_is_found(on_the_bus: Log) -> None:
    """Also of the stop frames after the last tick."""
    frames, rng = frame_records(on_the_bus.frames), np.random.default_rng(603)
    sent = np.nonzero((frames["received"] == 0) & (frames["can_id"] == 0x201))[0]
    for at in (*rng.choice(sent, 60), sent[-1], sent[-3]):
        changed = frames.copy()
        byte, bit = int(rng.integers(changed["size"][at])), int(rng.integers(8))
        changed["data"][at, byte] ^= 1 << bit
        first = checked(on_the_bus, on_the_bus.ticks, changed).difference
        assert first is not None, (int(at), byte, bit)


@pytest.mark.parametrize(
    ("data", "flag"), [(bytes(5), RxFlag.LENGTH_ERROR), (b"\x30\x81" + bytes(6), RxFlag.EMERGENCY)]
)
def test_an_emergency_counts_by_its_length(on_the_bus: Log, data: bytes, flag: RxFlag) -> None:
    """As the client judges it: what has not eight bytes says nothing but that."""
    ticks, before = on_the_bus.ticks.copy(), on_the_bus.frames
    at = next(i for i, frame in enumerate(before) if frame.t_ns == int(ticks["t_ns"][505]) and frame.received)
    frames = frame_records([*before[:at], before[at]._replace(can_id=0x81, data=data), *before[at:]])
    assert checked(on_the_bus, ticks, frames).difference is not None
    ticks["rx_flags"][505] |= int(flag)
    ticks["drive_error"][505:510] = 0x8130 if flag == RxFlag.EMERGENCY else 0
    assert checked(on_the_bus, ticks, frames).difference is None


def test_a_changed_command_is_named(on_the_bus: Log) -> None:
    """As if a tick had been changed whole, with its check made anew: its frame says what was sent."""
    frames, ticks = frame_records(on_the_bus.frames), on_the_bus.ticks.copy()
    ticks["u_q"][700] += 1.0
    first = checked(on_the_bus, ticks, frames).difference
    assert first is not None and (first.tick, first.field) == (700, "u_q")
    assert first.logged - first.replayed == pytest.approx(1.0, abs=0.01)


def test_a_changed_frame_is_a_verdict(on_the_bus: Log, tmp_path: Path) -> None:
    frames, path = frame_records(on_the_bus.frames), tmp_path / "a.mcap"
    at = int(np.nonzero(frames["can_id"] == 0x181)[0][500])
    frames["data"][at, 3] ^= 4
    with RunFile(
        path, {"metadata": on_the_bus.metadata["run"], "attachments": on_the_bus.attachments}
    ) as file:
        file.add_ticks(on_the_bus.ticks)
        file.add_frames(frames)
        file.finish(on_the_bus.result)
    verdict = replay(path)
    assert verdict.verdict == "differs" and verdict.first_difference is not None
    assert abs(verdict.first_difference.tick - 500) < 5
