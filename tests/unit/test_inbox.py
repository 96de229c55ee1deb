"""A live set-point on its way into the loop: taken once and whole, judged by the run, answered."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest

from hil.runtime.inbox import (
    ASKED,
    CHECK,
    CODE,
    HAS,
    I_Q,
    NODE,
    Answer,
    Inbox,
    Place,
    SetpointError,
    W,
    _check,
    ask,
    outside,
)
from hil.runtime.session import set_by_others
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, Request
from tests.conftest import CONFIGS

OPERATING, ARM = int(DriveState.OPERATION_ENABLED), int(Request.ARM)


@contextmanager
def box(name: str = "demo.toml", *settings: str) -> Iterator[Inbox]:
    setup = load_setup(CONFIGS / name, Overrides(settings=settings))
    with closing(Inbox(Place(setup.machine.fresh(), set_by_others(setup)))) as inbox:
        yield inbox


@contextmanager
def bench() -> Iterator[Inbox]:
    """Of the dyno bench's two nodes, both with a speed's range."""
    setup = load_setup(CONFIGS / "demo.toml", Overrides())
    takes = set_by_others(setup)
    with closing(
        Inbox(Place(setup.machine.fresh(), takes), Place(setup.machine.fresh(), takes, "load"))
    ) as both:
        yield both


def state_of(inbox: Inbox, node: int = 0) -> Any:
    return inbox._places[node].machine.setpoint_state[0]


def asked_of(
    inbox: Inbox, values: dict[str, float], *states: int, asked: int = ARM, node: int = 0
) -> list[str]:
    """Ask, while a loop looks once a millisecond; the events."""
    said: list[str] = []
    over = threading.Event()

    def loop() -> None:
        while not over.wait(0.001):
            if text := inbox.take(states or (OPERATING, OPERATING), asked):
                said.append(text)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        ask(os.getpid(), values, "a test", node=node)
    finally:
        over.set()
        thread.join()
    return said


def test_a_set_point_is_taken_once_and_told() -> None:
    with box() as inbox:
        assert asked_of(inbox, {"w": 60.0}) == ["w = 60 rad/s: taken, asked by a test"]
        state = state_of(inbox)
        assert (state["live_w"], state["w_target"], state["live_i_q"]) == (1, 60.0, 0)
        assert inbox.take([OPERATING], ARM) == ""
        assert asked_of(inbox, {"w": -20.0}) == ["w = -20 rad/s: taken, asked by a test"]
        assert state["w_target"] == -20.0


@pytest.mark.parametrize("value", [200.0, -135.1, math.nan, math.inf])
def test_what_is_out_of_range_is_refused_by_the_run_too(value: float) -> None:
    """The client looks first; the run does not rely on it."""
    with box() as inbox:
        with pytest.raises(SetpointError, match="out of the run's range"):
            asked_of(inbox, {"w": value})
        assert state_of(inbox)["live_w"] == 0


def test_a_run_that_does_not_operate_or_stops_refuses() -> None:
    with box() as inbox:
        with pytest.raises(SetpointError, match="not in operation yet"):
            asked_of(inbox, {"w": 60.0}, int(DriveState.SWITCHED_ON))
        with pytest.raises(SetpointError, match="is stopping"):
            asked_of(inbox, {"w": 60.0}, asked=int(Request.STOP))
        assert state_of(inbox)["live_w"] == 0


def test_half_of_a_set_point_is_not_there() -> None:
    with box() as inbox:
        inbox.cells[CHECK] = 1
        inbox.cells[ASKED] = 1
        assert inbox.take([OPERATING], ARM) == "" and inbox.cells[CODE] == Answer.NONE


def test_of_two_nodes_the_named_one_takes_it() -> None:
    """Judged by its own supervisor's state; an event of a node after the first begins with its name."""
    with bench() as both:
        assert asked_of(both, {"w": 60.0}, node=1) == ["load: w = 60 rad/s: taken, asked by a test"]
        assert (state_of(both, 0)["live_w"], state_of(both, 1)["live_w"]) == (0, 1)
        off = int(DriveState.SWITCHED_ON)
        assert asked_of(both, {"w": 20.0}, OPERATING, off) == ["w = 20 rad/s: taken, asked by a test"]
        assert (state_of(both, 0)["w_target"], state_of(both, 1)["w_target"]) == (20.0, 60.0)
        with pytest.raises(SetpointError, match="not in operation yet"):
            asked_of(both, {"w": 30.0}, OPERATING, off, node=1)
        for node in (2, -1):
            with pytest.raises(SetpointError, match="the run has no such node"):
                asked_of(both, {"w": 30.0}, node=node)
        assert (state_of(both, 0)["w_target"], state_of(both, 1)["w_target"]) == (20.0, 60.0)


def test_a_set_point_of_another_node_is_half_of_one() -> None:
    """The check holds the node: values of one write and the node of another are no set-point."""
    with bench() as both:
        asked_of(both, {"w": 60.0}, node=1)
        number = both.cells[ASKED] + 1
        cells = (both.cells[at] for at in (HAS, W, I_Q))
        both.cells[CHECK], both.cells[ASKED] = _check(number, *cells, 0), number
        assert both.cells[NODE] == 1 and both.take([OPERATING, OPERATING], ARM) == ""
        both.cells[NODE] = 0
        assert both.take([OPERATING, OPERATING], ARM).startswith("w = 60 rad/s: taken")


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
        assert (state_of(inbox)["w_target"], state_of(inbox)["i_q_target"]) == (60.0, 2.0)


@pytest.mark.parametrize("setting", ["setpoint.enabled=false", "loop.shadow=true"])
def test_a_run_may_take_none(setting: str) -> None:
    takes = set_by_others(load_setup(CONFIGS / "demo.toml", Overrides(settings=(setting,))))
    assert takes == {} and outside({"w": 1.0}, takes) == "this run takes no set-point"


def test_a_process_without_a_page_is_said() -> None:
    with pytest.raises(SetpointError, match="takes no set-point"):
        ask(os.getpid(), {"w": 1.0}, "a test")
