"""Pass or fail: what every run must be, and what its config demands of it in the table [criteria]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

from hil.config.limits import CriteriaTable
from hil.report.collect import Run
from hil.signals import Reason

Outcome = Literal["pass", "fail", "no data"]

SIGNS: Final[dict[Outcome, str]] = {"pass": "✓ pass", "fail": "✗ fail", "no data": "– no data"}


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the summary; ``no data`` is no pass."""

    name: str
    outcome: Outcome
    found: str
    wanted: str

    def as_dict(self) -> dict[str, str]:
        """JSON form."""
        return {"name": self.name, "outcome": self.outcome, "found": self.found, "wanted": self.wanted}


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of a run: key, what it is called, its unit, how it is read (None for no data).

    ``special``: of few laws, shown where there is one.
    """

    key: str
    name: str
    unit: str
    of: Callable[[Run], float | None]
    special: bool = False


def _worst(name: str) -> Callable[[Run], float | None]:
    """Worst of all responses; infinite when one never came to rest, none where no speed is followed."""

    def read(run: Run) -> float | None:
        never = float("inf") if name in run.responses.unfinished else None
        return (never or run.responses.worst.get(name)) if run.follows else None

    return read


def _followed(name: str) -> Callable[[Run], float | None]:
    """A figure of how a speed reference was followed."""
    return lambda run: getattr(run.totals, name) if run.follows else None


def _dip(run: Run) -> float | None:
    return run.excursions.dip if untold(run) else _worst("dip")(run)


def _recovery(run: Run) -> float | None:
    if not untold(run):
        return _worst("recovery_s")(run)
    return float("inf") if run.excursions.unfinished else run.excursions.recovery_s


def untold(run: Run) -> bool:
    """True for a log without the true load: dip and recovery come from estimate and reference."""
    return run.follows and run.totals.ticks > 0 and not run.excursions.truth


def notes(run: Run) -> dict[str, str]:
    """What to know of figures, by their keys."""
    if not untold(run):
        return {}
    span = run.excursions.load_span
    moved = "" if span is None else f"; the load estimate moved by {number(span, 'N m')}"
    text = f"from estimate and reference, the log has no true load{moved}"
    return dict.fromkeys(("dip_rad_s", "recovery_s"), text)


def _angle(name: str) -> Callable[[Run], float | None]:
    """A figure of how an angle was followed."""
    return lambda run: getattr(run.angles, name)


def _lateness(name: str) -> Callable[[Run], float | None]:
    return lambda run: run.phases.lateness.as_dict()[name] if run.totals.ticks else None


def _result(name: str) -> Callable[[Run], float | None]:
    def read(run: Run) -> float | None:
        value = run.log.result.get(name, 0 if run.log.result else None)
        return float(value) if isinstance(value, (int, float)) else None

    return read


def _flag(name: str) -> Callable[[Run], float | None]:
    return lambda run: run.totals.flags.get(name) if run.totals.ticks else None


def _busiest(run: Run) -> float | None:
    load = run.bus_load()
    return load[1] if load else None


FIGURES: Final = (
    Figure("tracking_rms_rad_s", "tracking error, rms", "rad/s", _followed("tracking_rms")),
    Figure("dip_rad_s", "worst dip after a load step", "rad/s", _dip),
    Figure("recovery_s", "slowest recovery to 0.5 rad/s", "s", _recovery),
    Figure("rise_s", "slowest rise, 10 to 90 %", "s", _worst("rise_s")),
    Figure("overshoot_percent", "largest overshoot", "%", _worst("overshoot_percent")),
    Figure("settling_s", "slowest settling to 2 %", "s", _worst("settling_s")),
    Figure("estimate_error_n_m", "load estimate off N ticks after a step", "N m", _worst("estimate_error")),
    Figure("ripple_rad_s", "speed ripple at rest, rms", "rad/s", _worst("ripple")),
    Figure("iae_rad", "integral of |w − w*|", "rad", _followed("iae")),
    Figure("angle_error_rms_rad", "following error of the angle, rms", "rad", _angle("rms"), True),
    Figure("angle_error_peak_rad", "largest following error of the angle", "rad", _angle("peak"), True),
    Figure("angle_settling_s", "settling to 0.01 rad after the last move", "s", _angle("settling_s"), True),
    Figure("skipped", "periods skipped", "", lambda run: run.totals.skipped),
    Figure("dropped", "records dropped", "", _result("dropped_ticks")),
    Figure("lost_feedback", "ticks in operation without fresh feedback", "", lambda run: run.totals.lost),
    Figure("crc_errors", "ticks with a CRC error", "", _flag("bus: crc error")),
    Figure("lateness_p999_us", "lateness, p99.9", "µs", _lateness("p999")),
    Figure("lateness_max_us", "lateness, largest", "µs", _lateness("max")),
    Figure("bus_load_percent", "bus load, busiest second", "%", _busiest),
)


def figures(run: Run) -> dict[str, float | None]:
    """All figures of a run by their keys."""
    return {figure.key: figure.of(run) for figure in FIGURES}


def number(value: float | None, unit: str = "") -> str:
    """A figure for people."""
    if value is None:
        return "–"
    if value == float("inf"):
        return "never"
    whole = float(value).is_integer() and abs(value) < 1e9
    return (f"{value:.0f}" if whole else f"{value:.4g}") + (f" {unit}" if unit else "")


def open_loop(run: Run) -> str:
    """What to know of a log that `hil replay --config -o` wrote; empty for a run."""
    found = run.log.metadata.get("run", {})
    if found.get("kind") != "what-if":
        return ""
    return (
        "open loop: what another controller would have estimated and asked for over the measurements of "
        f"{found.get('of', 'a log')}; the motor answered to the commands of that log, so speed and currents "
        "are that run's"
    )


def ending(run: Run) -> str:
    """How a run ended that nobody asked to end, in words; empty for one that was, and for no run."""
    if _asked(run) or open_loop(run) or run.log.metadata.get("run", {}).get("kind") == "import":
        return ""
    last = f"; its last tick is at {run.span_s:.3f} s" if run.totals.ticks else ""
    if not run.log.result:
        return f"how the run ended is not known, its log breaks off{last}"
    if run.ended == "controller died":
        return f"the controller died, what it had handed over was still written{last}"
    if run.ended.upper() in Reason.__members__:
        end = run.end
        why = f": {end['text']}; {end['remedy']}" if end else ""
        return f"the run ended in a trip, {run.ended.replace('_', ' ')}{why}{last}"
    return f"the run ended: {run.ended}{last}"


def recovered(run: Run) -> str:
    """What is known of the file that a recovered log was made from; empty for any other log."""
    found = run.log.metadata.get("recovered")
    return f"recovered from {found.get('from', 'a log')}, {found.get('damage', 'none')}" if found else ""


def limits(run: Run) -> dict[str, float]:
    """What the config demands: figure key to largest value; ``dip_max_rad_s`` limits ``dip_rad_s``."""
    if run.config is None or open_loop(run):
        return {}
    return demanded(run.config.criteria)


def demanded(criteria: CriteriaTable) -> dict[str, float]:
    """Figure key to largest value, in the order of :data:`FIGURES`."""
    given = {
        key.replace("_max", "", 1): float(value)
        for key, value in criteria.model_dump(exclude_none=True).items()
    }
    return {figure.key: given[figure.key] for figure in FIGURES if figure.key in given}


def judge(run: Run) -> list[Check]:
    """Every check of a run, those that need no config first."""
    most = limits(run)
    return [*_always(run), *(check_limit(run, f, most[f.key]) for f in FIGURES if f.key in most)]


def outcome_of(value: float | None, most: float) -> Outcome:
    """The verdict on a figure that may be ``most``."""
    return "no data" if value is None else "pass" if value <= most else "fail"


def check_limit(run: Run, figure: Figure, most: float) -> Check:
    """The check of one figure."""
    value = figure.of(run)
    outcome = outcome_of(value, most)
    note = notes(run).get(figure.key)
    found = number(value, figure.unit) + (f" ({note})" if note else "")
    return Check(figure.name, outcome, found, f"at most {number(most, figure.unit)}")


def _always(run: Run) -> list[Check]:
    """Ended as asked, log whole, nothing dropped, replay the same."""
    ended: Outcome = "no data" if open_loop(run) else _outcome(_asked(run))
    missing = run.totals.missing
    whole = run.log.damage is None and bool(run.log.result) and missing == 0
    found = run.log.damage or (f"{missing} records missing" if missing else "complete")
    verdict = run.verdict
    replayed: Outcome = {"same": "pass", "differs": "fail", "cannot": "no data"}[verdict.verdict]  # type: ignore[assignment]
    return [
        Check("ended", ended, run.ended.replace("_", " "), "stop requested"),
        Check("log", _outcome(whole), found if run.log.result else f"{found}; no result", "complete"),
        Check("replay", replayed, verdict_text(run), "same to the bit"),
    ]


def _asked(run: Run) -> bool:
    """Whether the run ended as it was asked to, or goes on in another part."""
    return run.ended in ("stop_requested", "quick_stop_requested") or run.ended.startswith("goes on in ")


def _outcome(good: bool) -> Outcome:
    return "pass" if good else "fail"


def verdict_text(run: Run) -> str:
    """The replay's verdict in one line."""
    verdict, first = run.verdict, run.verdict.first_difference
    text: dict[str, Any] = {"same": f"same, {verdict.ticks} ticks", "cannot": "cannot", "differs": "differs"}
    line = str(text[verdict.verdict])
    if first is not None:
        line += (
            f" at tick {first.tick}: {first.field} logged {first.logged!r}, replayed {first.replayed!r} "
            f"({first.ulp} ulp)"
        )
    return line + (f"; {verdict.why}" if verdict.why else "")
