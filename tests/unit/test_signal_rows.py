"""A row says where its field is shown: report, watch and what-if follow from it, for a new field as well."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from hil.replay.whatif import COMPARED
from hil.report.curves import CURVES, HEADS, PLOTS, plots_by_field
from hil.signals import FIELDS, Field, Shown, new_ticks
from hil.watch.feed import binned, live_plots
from hil.watch.terminal import curves, lines

SHOWN = [field for field in FIELDS if field.shown.plot]
NEW = Field(4711, "x_new", "f8", "K", "output", "a new signal", shown=Shown("x_new", "new", live="new"))


@pytest.mark.parametrize("field", SHOWN, ids=lambda field: field.name)
def test_a_fields_curve_is_in_its_plot_with_its_label_and_unit(field: Field) -> None:
    (plot,) = [plot for plot in PLOTS if plot.key == field.shown.plot]
    (curve,) = [curve for curve in plot.curves if curve.key == field.name]
    assert curve.label == field.shown.label and curve.compared == field.shown.compared
    said = {"µs": "us", "rad/s²": "rad/s2", "°C": "degC", "ticks": ""}.get(plot.unit, plot.unit)
    assert said == field.drawn_unit or field.kind == "u4"
    ticks = new_ticks(2)
    ticks[field.name], ticks["reason"] = 2000, [0, 1]
    after = np.nan if field.shown.until_stop else 2000 * field.scale
    if field.name != "reason":
        np.testing.assert_array_equal(curve.of(ticks), [2000 * field.scale, after])


def test_a_field_stands_once_in_a_plot_and_in_a_place_of_its_own() -> None:
    assert len(CURVES) == len({curve.key for curve in CURVES}) == len(SHOWN) + 2
    for plot in PLOTS:
        places = sorted(field.shown.place for field in SHOWN if field.shown.plot == plot.key)
        assert all(a < b for a, b in pairwise(places)), plot.key


def test_a_new_field_in_a_plot_there_is_and_in_one_of_its_own() -> None:
    joined = dataclasses.replace(NEW, shown=Shown("speed", "new", 9))
    plots = {plot.key: plot for plot in plots_by_field([*FIELDS, joined])}
    assert [curve.label for curve in plots["speed"].curves] == ["w*", "w", "new"]
    own = plots_by_field([*FIELDS, NEW])[-1]
    assert (own.key, own.title, own.unit) == ("x_new", "A new signal", "K")
    assert [curve.label for curve in own.curves] == ["new"] and len(HEADS) < len(
        plots_by_field([*FIELDS, NEW])
    )
    assert live_plots([*(f for f in FIELDS if f.shown.live), NEW])[-1] == ("new [K]", [("x_new", "x_new")])


def test_the_live_page_has_every_live_field() -> None:
    named = [key for _, curves in live_plots() for key, _ in curves]
    assert sorted(named) == sorted(field.name for field in FIELDS if field.shown.live) and len(named) == 11
    assert [title for title, _ in live_plots()] == [
        "speed [rad/s]", "current [A]", "command [V, or what the drive takes]",
        "load torque [N m]", "lateness [us]",
    ]  # fmt: skip
    assert set(binned(new_ticks(3), 1000)) == {"t", *named}


def test_what_if_compares_estimates_and_what_the_law_asks_for() -> None:
    assert set(COMPARED) == {
        "d_hat_w",
        "d_hat_q",
        "d_hat_d",
        "T_L_hat",
        "i_q_ref",
        "i_d_ref",
        "u_q_law",
        "u_d_law",
    }
    assert all(field.role == "output" for field in FIELDS if field.shown.what_if)


def test_the_terminal_has_every_field_with_a_line_and_a_new_one() -> None:
    assert [(field.shown.line, field.name, field.drawn_unit, field.shown.span) for field in lines()] == [
        ("speed", "w", "rad/s", 1.0), ("reference", "w_ref", "rad/s", 1.0),
        ("current q", "i_q", "A", 0.2), ("current d", "i_d", "A", 0.2),
        ("load estimate", "T_L_hat", "N m", 0.2), ("lateness", "lateness_ns", "us", 10.0),
        ("angle error", "theta_error", "rad", 0.01),
    ]  # fmt: skip
    ticks = new_ticks(20)
    ticks["v_dc"], ticks["lateness_ns"] = np.arange(20), 3000
    supply = dataclasses.replace(
        next(field for field in FIELDS if field.name == "v_dc"), shown=Shown(line="supply")
    )
    table = curves(ticks, 100, [*FIELDS, supply])
    labels, newest, units = ([str(cell) for cell in column.cells] for column in table.columns[:3])
    assert labels[-1] == "supply" and newest[-2:] == ["3.00", "19.00"] and units[-2:] == ["us", "V"]
