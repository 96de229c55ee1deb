"""A live set-point on its way into the loop: taken once and whole, judged by the run, answered."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from hil.runtime.inbox import ASKED, CHECK, CODE, Answer, Inbox, SetpointError, ask, outside
from hil.runtime.session import set_by_others
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, Request
from tests.conftest import CONFIGS

OPERATING, ARM = int(DriveState.OPERATION_ENABLED), int(Request.ARM)


@contextmanager
def box(name: str = "demo.toml", *settings: str) -> Iterator[Inbox]:
    setup = load_setup(CONFIGS / name, Overrides(settings=settings))
    with closing(Inbox(setup.machine.fresh(), set_by_others(setup))) as inbox:
        yield inbox


def asked_of(inbox: Inbox, values: dict[str, float], state: int = OPERATING, asked: int = ARM) -> list[str]:
    """Ask, while a loop looks once a millisecond; the events."""
    said: list[str] = []
    over = threading.Event()

    def loop() -> None:
        while not over.wait(0.001):
            if text := inbox.take(state, asked):
                said.append(text)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        ask(os.getpid(), values, "a test")
    finally:
        over.set()
        thread.join()
    return said


def test_a_set_point_is_taken_once_and_told() -> None:
    with box() as inbox:
        assert asked_of(inbox, {"w": 60.0}) == ["w = 60 rad/s: taken, asked by a test"]
        state = inbox._state
        assert (state["live_w"], state["w_target"], state["live_i_q"]) == (1, 60.0, 0)
        assert inbox.take(OPERATING, ARM) == ""
        assert asked_of(inbox, {"w": -20.0}) == ["w = -20 rad/s: taken, asked by a test"]
        assert state["w_target"] == -20.0


@pytest.mark.parametrize("value", [200.0, -135.1, math.nan, math.inf])
def test_what_is_out_of_range_is_refused_by_the_run_too(value: float) -> None:
    """The client looks first; the run does not rely on it."""
    with box() as inbox:
        with pytest.raises(SetpointError, match="out of the run's range"):
            asked_of(inbox, {"w": value})
        assert inbox._state["live_w"] == 0


def test_a_run_that_does_not_operate_or_stops_refuses() -> None:
    with box() as inbox:
        with pytest.raises(SetpointError, match="not in operation yet"):
            asked_of(inbox, {"w": 60.0}, state=int(DriveState.SWITCHED_ON))
        with pytest.raises(SetpointError, match="is stopping"):
            asked_of(inbox, {"w": 60.0}, asked=int(Request.STOP))
        assert inbox._state["live_w"] == 0


def test_half_of_a_set_point_is_not_there() -> None:
    with box() as inbox:
        inbox.cells[CHECK] = 1
        inbox.cells[ASKED] = 1
        assert inbox.take(OPERATING, ARM) == "" and inbox.cells[CODE] == Answer.NONE


def test_a_run_that_does_not_answer_is_said() -> None:
    with box(), pytest.raises(SetpointError, match="did not answer within"):
        ask(os.getpid(), {"w": 1.0}, "a test", timeout_s=0.05)


def test_each_law_takes_what_it_has_a_reference_for() -> None:
    cascade = set_by_others(load_setup(CONFIGS / "demo.toml", Overrides()))
    fac = set_by_others(load_setup(CONFIGS / "paper.toml", Overrides()))
    assert set_by_others(load_setup(CONFIGS / "dyno.toml", Overrides(settings=('node="load"',)))) == {}
    assert set(cascade) == {"w"} and set(fac) == {"w", "i_q"}
    assert cascade["w"] == pytest.approx((-135.0, 135.0, 150.0)) and fac["i_q"][:2] == (-13.5, 13.5)
    assert outside({"i_q": 1.0}, cascade) == "this run's law takes w, not i_q"
    assert outside({"w": 60.0, "i_q": 13.5}, fac) == ""
    with box("paper.toml") as inbox:
        asked_of(inbox, {"w": 60.0, "i_q": 2.0})
        assert (inbox._state["w_target"], inbox._state["i_q_target"]) == (60.0, 2.0)


@pytest.mark.parametrize("setting", ["setpoint.enabled=false", "loop.shadow=true"])
def test_a_run_may_take_none(setting: str) -> None:
    takes = set_by_others(load_setup(CONFIGS / "demo.toml", Overrides(settings=(setting,))))
    assert takes == {} and outside({"w": 1.0}, takes) == "this run takes no set-point"


def test_a_process_without_a_page_is_said() -> None:
    with pytest.raises(SetpointError, match="takes no set-point"):
        ask(os.getpid(), {"w": 1.0}, "a test")
