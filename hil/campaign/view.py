"""Campaigns and fleets as tables on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from hil.campaign.engine import Row
from hil.campaign.summary import name_of
from hil.report.criteria import number
from hil.report.view import key_values


def compare_tables(found: dict[str, Any]) -> list[Table]:
    """Two campaigns: yields and verdicts, figures, and the cases that passed before."""
    before, after = found["yield"]
    facts: dict[str, Any] = {
        "cases in both": found["cases"],
        "yield": f"{100 * before:.2f} to {100 * after:.2f} %",
    }
    if found["paired"]:
        facts |= {"passed before, not any more": found["regressions"], "pass now": found["mended"]}
    else:
        facts["pairs"] = "none: the plans differ, so medians and extremes alone are compared"
    figures = Table(title="figures", title_justify="left")
    for name in ("figure", "median", "worst", "mean difference", "worse in"):
        figures.add_column(name, justify="left" if name == "figure" else "right")
    for key, one in found["figures"].items():
        difference = one.get("difference")
        mean = f"{difference['mean']:+.4g}" if difference else "-"
        pairs = (" to ".join(number(value) for value in one[name]) for name in ("median", "worst"))
        figures.add_row(name_of(key), *pairs, mean, str(one.get("worse_in", "-")))
    out = [key_values(f"{found['before']} to {found['after']}", facts), figures]
    regressed = {
        f"case {one['case']}": f"{one['why']}\n{one['command']}" for one in found.get("regressed", [])
    }
    return [*out, key_values("regressions", regressed)] if regressed else out


def fleet_table(rows: Sequence[Row]) -> Table:
    """A log a row."""
    out = Table(title="hil replay --fleet", title_justify="left")
    for name in ("log", "verdict", "ended", "tracking", "dip", "why it does not pass"):
        out.add_column(name, overflow="fold")
    for row in rows:
        figures = (number(row.get(key), "rad/s") for key in ("tracking_rms_rad_s", "dip_rad_s"))
        out.add_row(row["log"], row["verdict"], row["ended"].replace("_", " "), *figures, row["why"])
    return out


def what_if_table(rows: Sequence[Row]) -> Table:
    """A log a row: new less logged, rms."""
    out = Table(title="hil campaign --what-if, rms of new - logged", title_justify="left")
    names = ("d_hat_w", "T_L_hat", "i_q_ref", "u_q_law", "u_d_law")
    for name in ("log", *names, "why not"):
        out.add_column(name, overflow="fold")
    for row in rows:
        out.add_row(row["log"], *(number(row.get(f"{name}_rms")) for name in names), row["why"])
    return out
