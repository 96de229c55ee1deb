"""Tables of a comparison and of a design for the terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from hil.report.view import key_values
from hil.tuning.page import cell, columns, noise_of


def comparison_table(found: dict[str, Any]) -> Table:
    """One row a law, the configuration itself first."""
    limits = found["limits"]
    title = (
        f"hil compare {found['config']}: {noise_of(limits, found['bench']['unit'])}, "
        f"Ms {limits['ms']:.2f}/{limits['ms_worst']:.2f}"
    )
    table = Table(title=title, title_justify="left")
    titles = columns(found)
    for name, text in titles.items():
        table.add_column(text, justify="left" if name == "law" else "right")
    for row in (found["as_configured"], *found["rows"]):
        table.add_row(*(cell(row, name) for name in titles))
    return table


def design_table(found: dict[str, Any]) -> Table:
    """What a design is and does."""
    rows: dict[str, Any] = {"law": found["law"]}
    rows |= {key: f"{value:g} rad/s" for key, value in found["poles"].items() if key.endswith("pole_rad_s")}
    for name, w in found["windows"].items():
        rows[f"{name} window"] = (
            f"N = {w['N']} (D = {w['D_ms']:g} ms), sigma_d {w['sigma_d']:.3g}, one LSB up to "
            f"{w['lsb_bound']:.3g}, lag {w['lag_ms']:.1f} ms, peak |H| {w['peak_H']:.2f}"
        )
        if "short_N" in w:
            rows[f"{name}, after a change"] = (
                f"N = {w['short_N']}, the first {w['first_N']}; sigma_d {w['short_sigma_d']:.3g}, lag "
                f"{w['short_lag_ms']:.1f} ms; margins are of this one"
            )
    margins = found["margins"]
    rows |= {
        "dip, nominal / worst corner": f"{found['dip']:.2f} / {found['worst_dip']:.2f} rad/s",
        "back in 0.5 rad/s": f"{found['recovery_ms']:.0f} / {found['worst_recovery_ms']:.0f} ms",
        "IAE": f"{found['iae']:.3f} / {found['worst_iae']:.3f} rad",
        "noise": f"{noise_of(found, found['bench']['unit'])}, w {found['w_noise_mrad_s']:.2f} mrad/s",
        "Ms": f"{found['ms']:.2f} / {found['ms_worst']:.2f}",
        "margins": f"gain {margins['gain']:.1f}, phase {margins['phase_deg']:.0f} deg, "
        f"delay {margins['delay_ms']:.1f} ms",
        "limited by": ", ".join(found["limited_by"]) or "nothing that was wished for",
    }
    if verified := found.get("verified"):
        rows["verified"] = (
            f"{'as predicted' if verified['ok'] else 'NOT as predicted'}: dips within "
            f"{verified['worst_dip_off']:.1%}, noise within {verified['worst_noise_off']:.1%}, bus "
            f"{_bus(verified)}"
        )
    rows |= {"written": found["written"], "front": found["picture"], "took": f"{found['seconds']:.1f} s"}
    return key_values("hil design", rows)


def _bus(verified: dict[str, Any]) -> str:
    """How the bus agrees with the simulation."""
    off = (
        f"dips within {verified['worst_bus_dip_off']:.1%}, noise within {verified['worst_bus_noise_off']:.1%}"
    )
    return "same to the bit" if verified["bus_same"] else f"not the same bits: {off} of the simulation's"
