"""The judge of the fault matrix on made-up logs: a stall that nobody felt, a voltage after the stop."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import pytest

from hil.faults.judge import Evidence, Result, _judge_faults, _judge_frames, silence_ms
from hil.faults.matrix import Stall
from hil.signals import Reason, new_ticks

COMMAND_ID = 0x201


def ticks_at(*woken_ms: float) -> Any:
    """Ticks of a 1 kHz loop that woke at these times; whole periods late are skipped."""
    ticks = new_ticks(len(woken_ms))
    for tick, woken in zip(ticks, woken_ms, strict=True):
        tick["t_ns"] = int(woken) * 1_000_000
        tick["lateness_ns"] = round(woken * 1e6) - int(tick["t_ns"])
    return ticks


@pytest.mark.parametrize(
    ("woken_ms", "why"),
    [
        ((0.0, 1.0, 7.4, 8.0), []),
        ((0.0, 1.0, 5.1, 6.0), []),  # stopped in its sleep: a period less
        ((0.0, 1.0, 3.9, 5.0), ["did nothing: stall, the loop was silent for 2.9 ms at most"]),
    ],
)
def test_a_stall_must_show_in_the_ticks(woken_ms: tuple[float, ...], why: list[str]) -> None:
    result = Result("", "")
    log: Any = SimpleNamespace(ticks=ticks_at(*woken_ms))
    stall = Stall(kind="stall", at_s=0.0, for_ms=5)
    _judge_faults(result, Evidence(log, {"acted": []}, 1, 0.0, stall))
    assert result.why == why


def test_silence_is_counted_from_one_wake_up_to_the_next() -> None:
    assert silence_ms(ticks_at(0.0, 1.25, 4.5)) == pytest.approx(3.25)
    assert silence_ms(ticks_at(0.0)) == 0.0


@pytest.mark.parametrize(
    ("sent_ms", "asked", "good"),
    [(2.2, False, True), (2.4, False, False), (2.4, True, True), (2.5, True, True), (2.6, True, False)],
)
def test_a_stop_begins_when_its_tick_woke_up(sent_ms: float, asked: bool, good: bool) -> None:
    ticks = ticks_at(0.0, 1.0, 2.3)
    ticks["computed_ns"][2] = 500_000
    ticks["reason"][2] = int(Reason.BUS_DOWN)
    frame = SimpleNamespace(received=False, can_id=COMMAND_ID, t_ns=round(sent_ms * 1e6), data=b"\x01\x00")
    log: Any = SimpleNamespace(ticks=ticks, frames=[frame])
    result = Result("", "")
    _judge_frames(result, log, COMMAND_ID, lambda data: tuple(map(float, struct.unpack("<h", data))), asked)
    assert (result.why == []) == good
