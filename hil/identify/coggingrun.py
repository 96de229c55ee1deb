"""The run that learns the cogging, on the bus or in logs, and what comes of it: result, file, picture."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.config.design import law_spec
from hil.config.limits import CriteriaTable
from hil.config.motor import AnticoggingTable
from hil.config.reference import TableReference
from hil.config.tables import RunConfig, validate
from hil.control.errors import ControlDesignError
from hil.control.law import Record, design_law
from hil.errors import ConfigError, HilError
from hil.identify.cogging import Cogging, learned, response, rows_of
from hil.identify.estimate import Parameter
from hil.identify.motorfile import number, quoted
from hil.log.parts import grouped
from hil.log.reader import open_log
from hil.runtime.loop import StopRequest
from hil.runtime.session import run
from hil.runtime.setup import Setup, setup_of
from hil.signals import Reason, TickArray

NAME: Final = "cogging"
LAPS: Final = (2, 4)
"""Whole laps in each direction, by rounds: in the second the first's table keeps the speed steady, so that
neither a wrong J nor friction that falls with speed is taken for torque over the angle."""
SPEED: Final = 2.0 * math.pi / 3.0
"""Speed of the laps [rad/s]: a turn in three seconds."""
REST_S: Final = 1.0
"""To get to speed, and to turn round."""
UNIT: Final = "N m"


def speed_of(config: RunConfig) -> float:
    """Speed of the laps [rad/s]: as slow as half of w_max allows at most."""
    return min(SPEED, 0.5 * config.limits.w_max_rad_s)


def run_config(config: RunConfig, log_name: str, laps: int) -> RunConfig:
    """Laps forward, then back, by the configuration's own law, observer and limits."""
    w = speed_of(config)
    side = (laps + 0.5) * 2.0 * math.pi / w + REST_S
    t = [0.0, 0.2 * REST_S, 0.7 * REST_S, side, side + REST_S, 2.0 * side, 2.0 * side + 0.5 * REST_S]
    reference = TableReference(kind="table", t_s=t, w_rad_s=[0.0, 0.0, w, w, -w, -w, 0.0])
    changes = {
        "reference": reference,
        "loop": config.loop.model_copy(update={"duration_s": t[-1] + 0.2}),
        "log": config.log.model_copy(update={"name": log_name, "split_s": None, "split_mb": None}),
        "criteria": CriteriaTable(),
    }
    return config.model_copy(update=changes)


def table_of(found: Cogging, config: RunConfig, logs: Sequence[str]) -> AnticoggingTable | None:
    """What ``controller.anticogging`` takes; None when no harmonic was found."""
    if not found.known.orders:
        return None
    drive = config.drive
    return AnticoggingTable(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        drive=f"node {drive.node_id} of {drive.dbc} on {config.bus.interface}:{config.bus.channel}",
        logs=list(logs),
        motor=config.motor.name,
        n_p=config.motor.n_p,
        k_t_n_m_a=config.k_t,
        speed_rad_s=found.speed,
        laps=found.laps,
        residual_n_m=found.residual,
        orders=list(found.known.orders),
        cos_n_m=list(found.known.a),
        sin_n_m=list(found.known.b),
        error_n_m=list(found.half),
    )


def with_table(config: RunConfig, table: AnticoggingTable | None) -> RunConfig:
    """The configuration with that table, in which a weight's torque is too."""
    controller = config.controller.model_copy(update={"anticogging": table, "known_load": None})
    return config.model_copy(update={"controller": controller})


def checked(path: Path, config: RunConfig) -> None:
    """Refuse what can't be learned from. Raises ConfigError."""
    if config.loop.shadow:
        raise ConfigError(
            str(path), ["loop.shadow: a shadow run sends nothing; hil identify moves the motor"]
        )
    if config.controller.kind in ("fac", "identify"):
        raise ConfigError(
            str(path),
            [f"controller.kind: {config.controller.kind} follows no speed of its own; take cascade"],
        )


def ready(path: Path, setup: Setup) -> None:
    """Refuse what can't be learned from, and a drive whose angle nobody knows. Raises ConfigError."""
    checked(path, setup.config)
    if setup.binding.signal("angle") is None:
        raise ConfigError(
            str(path),
            ["drive.signals.angle: missing; cogging is learned over the angle that the drive reports"],
        )


def on_the_bus(path: Path, config: RunConfig, say: Callable[[str], None], *, arm: bool) -> dict[str, Any]:
    """Run and learn. Raises HilError before anything is sent; ``ok``: the runs ended well."""
    rows: list[dict[str, Any]] = []
    faults: list[str] = []
    found = None
    for laps in LAPS:
        setup = _setup(path, config, laps)
        g = response(setup.config, "i_q" in setup.wire.measured)
        seconds, w = setup.config.loop.duration_s or 0.0, speed_of(config)
        say(f"step {NAME}, {seconds:.1f} s: {laps} turns forward at {w:.3g} rad/s, then as many back")
        request = StopRequest()
        result = run(setup, arm=arm, request=request)
        ended = Reason(int(result.outcome.reason)).name.lower()
        seconds = result.outcome.ticks / config.loop.rate_hz
        rows.append({"step": NAME, "log": result.log, "ended": ended, "motor_s": seconds})
        if not result.ok or request.value in StopRequest.STOPS:
            why = result.end.text if result.end else ended
            faults.append(f"step {NAME} was stopped" if result.ok else f"step {NAME} ended: {why}")
            found = None
            break
        found = of_runs([(open_log(Path(str(result.log)), frames=False).ticks, setup.machine.law)], g, config)
        config = with_table(config, table_of(found, config, [str(result.log)]))
    logs, motor_s = [str(row["log"]) for row in rows], sum(row["motor_s"] for row in rows)
    return result_of(found, faults) | {"config": str(path), "steps": rows, "logs": logs, "motor_s": motor_s}


def _setup(path: Path, config: RunConfig, laps: int) -> Setup:
    """A run of the step. Raises HilError."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    try:
        made = run_config(config, f"{config.log.name or path.stem}-identify-{NAME}-{stamp}", laps)
        setup = setup_of(path, made)
    except ControlDesignError as error:
        raise HilError(f"step {NAME}: {error}") from error
    ready(path, setup)
    return setup


def from_logs(paths: Sequence[Path]) -> tuple[dict[str, Any], RunConfig]:
    """What logged runs tell together, and the newest one's configuration. Raises HilError."""
    runs, first = [], None
    for parts in grouped(paths):
        log = open_log(parts if len(parts) > 1 else parts[0], frames=False)
        ticks = log.ticks
        if "theta" in log.absent or not np.isfinite(ticks["theta"]).any():
            raise HilError(
                f"{parts[0]}: its drive reported no angle (drive.signals.angle), so nothing is over it"
            )
        config = config_in(log, parts[0])
        told = bool(np.isfinite(ticks["i_q"]).any())
        design = design_law(law_spec(config, told), 1.0 / config.loop.rate_hz)
        g = response(config, told)
        first = first or (config, g)
        if len(g) != len(first[1]) or not np.allclose(g, first[1]) or config.motor.n_p != first[0].motor.n_p:
            raise ConfigError(
                "--from", ["the runs differ in motor, loop.rate_hz or observer; learn from alike ones"]
            )
        runs.append((ticks, design))
    assert first is not None  # noqa: S101 - the command line takes one at least
    result = result_of(of_runs(runs, first[1], config), [])
    return result | {"logs": [str(path) for path in paths]}, config


def config_in(log: Any, path: Path) -> RunConfig:
    """The configuration that a log holds. Raises HilError for none."""
    text = log.attachments.get("config.json")
    if text is None:
        raise HilError(f"{path}: holds no configuration; hil identify needs a run's own log")
    try:
        return validate(json.loads(text), RunConfig, f"{path}: config.json", None)
    except ValueError as error:
        raise HilError(f"{path}: its configuration can't be read ({error})") from error


def of_runs(runs: Sequence[tuple[TickArray, Record]], g: Any, config: RunConfig) -> Cogging:
    """What runs tell together. Raises HilError."""
    T_s = 1.0 / config.loop.rate_hz
    found = learned([rows_of(ticks, law[0], g, T_s) for ticks, law in runs])
    w = np.concatenate([np.abs(ticks["w_ref"][ticks["w_ref"] != 0.0]) for ticks, _ in runs])
    found.speed = float(np.median(w))
    return found


def result_of(found: Cogging | None, faults: Sequence[str]) -> dict[str, Any]:
    """JSON form, with the keys of hil identify; ``cogging`` has what is special to it."""
    parameters = {} if found is None else parameters_of(found)
    findings = []
    if found is not None and not found.known.orders:
        findings = [f"no harmonic stands out of {found.residual:.2g} N m rms: nothing to compensate"]
    return {
        "parameters": {name: p.as_dict() for name, p in parameters.items()},
        "cogging": None if found is None else as_dict(found),
        "findings": findings,
        "faults": list(faults),
        "white": {},
        "ok": not faults and found is not None and bool(found.known.orders),
        "found": found,
    }


def as_dict(found: Cogging) -> dict[str, Any]:
    """JSON form of what was learned."""
    rows = zip(found.known.orders, found.known.a, found.known.b, found.half, strict=True)
    return {
        "harmonics": [
            {"order": n, "cos_n_m": a, "sin_n_m": b, "amplitude_n_m": math.hypot(a, b), "error_n_m": e}
            for n, a, b, e in rows
        ],
        "peak_n_m": found.known.peak,
        "rms_n_m": found.before,
        "residual_n_m": found.residual,
        "friction_n_m": found.friction if math.isfinite(found.friction) else None,
        "speed_rad_s": found.speed,
        "laps": found.laps,
    }


def parameters_of(found: Cogging) -> dict[str, Parameter]:
    """Amplitude of each harmonic with its interval, and the peak, residual and friction as they are."""
    out = {}
    for n, size, e in zip(found.known.orders, found.amplitudes, found.half, strict=True):
        out[f"order_{n}"] = Parameter(float(size), max(float(size) - e, 0.0), float(size) + e, UNIT)
    return out


def toml_of(table: AnticoggingTable) -> str:
    """The file that ``[controller] anticogging`` names."""
    lines = [
        "# Load torque over the shaft's angle, learned by hil identify --steps cogging:",
        "# T_c(theta) = sum of cos_n_m cos(n theta) + sin_n_m sin(n theta), against positive speed.",
        '# [controller] anticogging = "THIS FILE" compensates it. error_n_m: half of the 95 % intervals.',
        "",
    ]
    return "\n".join([*lines, *(f"{key} = {_toml(value)}" for key, value in table.model_dump().items()), ""])


def _toml(value: Any) -> str:
    """A value as TOML has it."""
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return (
        quoted(value) if isinstance(value, str) else number(value) if isinstance(value, float) else str(value)
    )


def picture(found: Cogging) -> bytes:
    """PNG: the torque over a turn with what it leaves, and the amplitudes with their errors."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(9, 5), dpi=100, layout="constrained")
    FigureCanvasAgg(drawn)
    turn, sizes = drawn.subplots(2, 1)
    theta = np.linspace(0.0, 2.0 * math.pi, 2000)
    torque = found.known.torque(theta)
    turn.fill_between(np.degrees(theta), torque - found.residual, torque + found.residual, color="#c9d8e8",
                      label=f"+- {found.residual:.2g} N m rms that no harmonic explains")  # fmt: skip
    turn.plot(np.degrees(theta), torque, color="#0b62c4", linewidth=1.0, label="learned")
    turn.set(xlabel="angle of the shaft [deg]", ylabel="load torque [N m]", xlim=(0, 360))
    turn.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8)
    names = [str(n) for n in found.known.orders]
    sizes.bar(names, found.amplitudes, color="#0b62c4")
    sizes.errorbar(names, found.amplitudes, yerr=found.half, fmt="none", ecolor="#d1570a", capsize=4)
    sizes.set(xlabel="order", ylabel="amplitude [N m], 95 %")
    out = io.BytesIO()
    drawn.savefig(out, format="png")
    return out.getvalue()
