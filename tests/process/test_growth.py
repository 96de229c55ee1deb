"""The loop, ring and client over thousands of ticks: nothing grows, nothing is left for the collector."""

from __future__ import annotations

import gc
import os
import signal
import sys
from pathlib import Path

import pytest

from drivers.bus import BusSettings, Link, open_link
from drivers.client import DriveClient
from hil.log.recorder import Recorder
from hil.runtime import fused
from hil.runtime.clock import LockstepClock, RealClock
from hil.runtime.header import header_of
from hil.runtime.loop import Loop, Plan, StopRequest, Whole, none_compiled
from hil.runtime.rules import NOT_BEGUN, Pace
from hil.runtime.setup import Overrides, load_setup
from tests.conftest import CONFIGS

pytestmark = [pytest.mark.process, pytest.mark.compiled]
TICKS, SETTLED = 1900, 300  # the drive never enables: the run ends itself after 2000


def answering(peer: Link, answers: list[bytes], statuses: list[bytes]) -> int:
    """A process that answers each SYNC; its id."""
    pid = os.fork()
    if pid == 0:
        k = 0
        while True:
            frame = peer.receive(10**9)
            if frame is not None and frame.can_id == 0x80:
                k += 1
                if k % 10 == 1:
                    peer.send(0x281, statuses[k // 10 % 16])
                peer.send(0x181, answers[k % 16])
    return pid


@pytest.mark.parametrize("compiled", [False, True], ids=["the loop's rules", "the compiled tick"])
def test_a_tick_leaves_nothing_behind(tmp_path: Path, channel: str, compiled: bool) -> None:
    setup = load_setup(CONFIGS / "demo.toml", Overrides())
    machine, clock = setup.machine.fresh(), RealClock() if compiled else LockstepClock()
    setup.machine.warm_up()
    recorder = Recorder(tmp_path / "run.mcap", header_of(setup, "run", "lockstep"), 2000)
    recorder.await_open()
    settings = BusSettings("hil-local", channel)
    peer, link = open_link(settings), open_link(settings)
    client = DriveClient(link, setup.database, on_frames=recorder.frames)
    feedback = setup.database.message("FEEDBACK")
    answers = [feedback.encode({"Counter": k, "State": 1}) for k in range(16)]
    status = setup.database.message("STATUS")
    statuses = [status.encode({"Counter": k, "DcLinkVoltage": 540.0}) for k in range(16)]
    seen: list[tuple[int, int]] = []
    request = StopRequest()
    plan, step = Plan(1_000_000, 800_000, "sync", TICKS), machine.looped()
    count = left = 0

    def looked(pace: Pace) -> Whole:
        parts = client, None, machine, recorder, plan, request, pace
        made = fused.whole_tick(*parts) if compiled else none_compiled

        def whole(k: int, deadline_ns: int, log_failed: bool) -> int:
            nonlocal count, left
            count += 1
            if len(seen) < 2 and k >= (SETTLED, TICKS - 10)[len(seen)]:  # a busy host skips ticks
                seen.append((gc.get_count()[0], sys.getallocatedblocks()))
            stage = made(k, deadline_ns, log_failed)
            left += stage == NOT_BEGUN
            return stage

        return whole

    drive = answering(peer, answers, statuses)
    loop = Loop(client, clock, recorder, step, recorder.record, plan, request, looked)
    gc.collect()
    gc.disable()
    try:
        loop.run()
    finally:
        gc.enable()
        os.kill(drive, signal.SIGKILL)
        os.waitpid(drive, 0)
        recorder.close({})
        client.close()
        peer.close()
    assert len(seen) == 2, "the loop ended early"
    assert left < count if compiled else left == count
    (objects, blocks), (objects_then, blocks_then) = seen
    assert objects_then - objects <= 20, "a tick leaves objects for the collector"
    assert blocks_then - blocks <= 200, "memory grows with the ticks"
