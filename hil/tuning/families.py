"""The laws that can be tuned: what each leaves free, its bounds, and the config tables that follow.

A family is a law and an observer of the registry with free numbers; one for a drive with a current loop of
its own (``OWN_LOOP``) has the same observer on the speed alone, under the law ``speed``. Bounds are in
units of the tick and of the motor, so that one family serves every drive. Poles of the paper's window follow
its length: gamma D = 0.3, 0.7.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from hil.control.registry import observers
from hil.errors import HilError
from hil.tuning.measure import Bench

Tables = dict[str, dict[str, Any]]
"""``controller``, ``speed`` and, of a drive that takes voltages, ``current``, as the config takes them."""
Bounds = Sequence[tuple[float, float]]

_POLES: Final = ((0.005, 0.4), (0.25, 1.5))
"""Speed pole and current pole, times T_s; slower currents would leave the cascade's premise."""
_LENGTH: Final = ((1.0, 64.0), (1.0, 40.0))
"""Length of the window of speed and current [ticks]."""


@dataclass(frozen=True, slots=True)
class Family:
    """``free``: bounds of the free numbers; ``whole``: which are ticks; ``tables`` makes a config of them."""

    law: str
    doc: str
    free: Bounds
    tables: Callable[[Sequence[float], Bench], Tables]
    whole: tuple[int, ...] = ()
    own_loop: bool = False

    def __reduce__(self) -> tuple[Any, ...]:
        """To another process by its name."""
        return family, (self.law, self.own_loop)


def _cascade(x: Sequence[float], bench: Bench) -> dict[str, Any]:
    return {
        "kind": "cascade",
        "speed_pole_rad_s": round(float(x[0]) / bench.T_s, 1),
        "current_pole_rad_s": round(float(x[1]) / bench.T_s, 1),
    }


def _ms(ticks: float, bench: Bench) -> float:
    """Of whole samples: ticks, where each has a measurement."""
    return round(max(1, round(ticks)) * bench.every * bench.T_s * 1e3, 6)


def _noise(bench: Bench) -> dict[str, float]:
    return {"w_noise_rad_s": float(f"{bench.w_noise:.4g}"), "i_noise_a": float(f"{bench.i_noise:.4g}")}


def _windows(channel: Callable[[float, Bench], dict[str, Any]]) -> Callable[[Sequence[float], Bench], Tables]:
    """Cascade over two windows, of x[2] and x[3] ticks."""

    def tables(x: Sequence[float], bench: Bench) -> Tables:
        speed, current = (channel(ticks, bench) for ticks in x[2:4])
        return {"controller": _cascade(x, bench), "speed": speed, "current": current}

    return tables


def _paper(ticks: float, bench: Bench) -> dict[str, Any]:
    D = _ms(ticks, bench)
    gamma = {"gamma_1_rad_s": round(300.0 / D, 3), "gamma_2_rad_s": round(700.0 / D, 3)}
    return {"kind": "ftdob", **gamma, "delay_ms": D}


def _least(ticks: float, bench: Bench) -> dict[str, Any]:
    return {"kind": "least-noise", "delay_ms": _ms(ticks, bench), **_noise(bench)}


def _cubic(ticks: float, bench: Bench) -> dict[str, Any]:
    return {"kind": "cubic", "delay_ms": _ms(ticks, bench)}


def _ramp(ticks: float, bench: Bench) -> dict[str, Any]:
    return {"kind": "ramp-exact", "delay_ms": _ms(max(2, ticks), bench), "lead_ticks": 1.5}


def _three(ticks: float, bench: Bench) -> dict[str, Any]:
    D = _ms(max(4, ticks), bench)
    gammas = [round(gD * 1e3 / D, 3) for gD in (0.5, 1.0, 1.5)]
    return {"kind": "exponentials", "gammas_rad_s": gammas, "delay_ms": D, **_noise(bench)}


def _adaptive(x: Sequence[float], bench: Bench) -> Tables:
    """x[2], x[3]: short windows of speed and current; x[4]: the long one of both; the first a sixth.

    One noise is told for both currents: the larger, so that no step of i_d's frame is an alarm.
    """
    noise = _noise(replace(bench, i_noise=max(bench.i_noise, bench.i_d_noise)))
    speed, current = (
        {
            "kind": "adaptive",
            "delay_ms": _ms(max(x[4], short), bench),
            "short_ms": _ms(short, bench),
            "first_ms": _ms(short / 6, bench),
            **noise,
        }
        for short in x[2:4]
    )
    return {"controller": _cascade(x, bench), "speed": speed, "current": current}


def _dob_channel(gamma: float, bench: Bench) -> dict[str, Any]:
    return {"kind": "dob", "gamma_1_rad_s": round(gamma / bench.T_s, 2)}


def _ramp_tables(x: Sequence[float], bench: Bench) -> Tables:
    return _windows(_least)(x, bench) | {"speed": _ramp(x[2], bench)}


def _eso(x: Sequence[float], bench: Bench) -> Tables:
    speed, current = (
        {"kind": "eso", "bandwidth_rad_s": round(w0 / bench.T_s, 2), "damping": round(zeta, 3)}
        for w0, zeta in zip(x[2:4], x[4:6], strict=True)
    )
    return {"controller": _cascade(x, bench), "speed": speed, "current": current}


def _pi(x: Sequence[float], bench: Bench) -> Tables:
    """x: speed pole, its integral's, current pole, its integral's, all times T_s."""
    motor, (a, b, c, d) = bench.motor, (value / bench.T_s for value in x)
    k_w, k_c = motor.J * a / motor.k_t, motor.L_q * c
    gains = {"speed_gain_as_rad": k_w, "speed_integral_a_rad": k_w * b}
    gains |= {"current_gain_v_a": k_c, "current_integral_v_as": k_c * d}
    controller = {"kind": "pi"} | {name: float(f"{gain:.4g}") for name, gain in gains.items()}
    return {"controller": controller, "speed": _paper(12, bench), "current": _paper(10, bench)}


def _kalman(x: Sequence[float], bench: Bench) -> Tables:
    """x: LQ weights of w and i_q, random walks of the two disturbances, all in units of the motor."""
    motor, T = bench.motor, bench.T_s
    volt = motor.L_q / T  # of one ampere a tick
    weights = x[0] * (volt * motor.J / (motor.k_t * T)) ** 2, x[1] * volt**2
    walks = x[2] * bench.w_noise / T**2, x[3] * bench.i_noise / T**2
    speed, current = (
        {"kind": "kalman", "d_walk_per_s": float(f"{walk:.4g}"), "x_noise": float(f"{noise:.4g}")}
        for walk, noise in zip(walks, (bench.w_noise, bench.i_noise), strict=True)
    )
    law = {
        "kind": "lq",
        "speed_weight": float(f"{weights[0]:.4g}"),
        "current_weight": float(f"{weights[1]:.4g}"),
    }
    return {"controller": law, "speed": speed, "current": current}


def _deadbeat(x: Sequence[float], bench: Bench) -> Tables:
    speed, current = (_dob_channel(gamma, bench) for gamma in x[1:3])
    law = {"kind": "deadbeat", "speed_pole_rad_s": round(x[0] / bench.T_s, 1)}
    return {"controller": law, "speed": speed, "current": current}


def _windowed(law: str, doc: str, tables: Callable[[Sequence[float], Bench], Tables]) -> Family:
    """Two poles and two lengths in whole ticks."""
    return Family(law, doc, (*_POLES, *_LENGTH), tables, (2, 3))


_GAMMA: Final = ((0.015, 2.5), (0.015, 2.5))
FAMILIES: Final[dict[str, Family]] = {
    family.law: family
    for family in (
        Family("pi", "PI with anti-windup", ((5e-3, 1.0), (5e-4, 0.3), (0.015, 1.8), (0.04, 2.0)), _pi),
        Family("dob", "conventional DOB", (*_POLES, *_GAMMA), _windows(_dob_channel)),
        Family("eso", "linear ESO, damping free", (*_POLES, *_GAMMA, (0.5, 1.0), (0.5, 1.0)), _eso),
        Family("kalman", "Kalman with LQ", ((1e-5, 1.0), (1e-6, 1.0), (1e-3, 3.0), (1e-3, 3.0)), _kalman),
        Family("deadbeat", "deadbeat currents, DOB", (_POLES[0], *_GAMMA), _deadbeat),
        _windowed("ftdob", "the paper's FTDOB", _windows(_paper)),
        _windowed("least-noise", "least-noise window", _windows(_least)),
        _windowed("cubic", "cubic window", _windows(_cubic)),
        _windowed("exponentials", "three exponentials", _windows(_three)),
        Family("adaptive", "adaptive window", (*_POLES, *_LENGTH, (16.0, 120.0)), _adaptive, (2, 3, 4)),
        _windowed("ramp-exact", "ramp-exact window", _ramp_tables),
    )
}


def _speed(channel: Callable[[float, Bench], dict[str, Any]]) -> Callable[[Sequence[float], Bench], Tables]:
    """The law ``speed`` over one window, of x[1] samples; or ``position``, its poles in a fixed ratio."""

    def tables(x: Sequence[float], bench: Bench) -> Tables:
        pole = round(float(x[0]) / bench.T_s, 2)
        controller = {"kind": "speed", "speed_pole_rad_s": pole}
        if bench.theta_noise is not None:
            controller |= {"kind": "position", "position_pole_rad_s": round(POSITION_SHARE * pole, 2)}
        return {"controller": controller, "speed": channel(x[1], bench)}

    return tables


def _speed_eso(x: Sequence[float], bench: Bench) -> Tables:
    """x[1:3]: bandwidth times T_s, damping."""
    eso = {"kind": "eso", "bandwidth_rad_s": round(x[1] / bench.T_s, 2), "damping": round(x[2], 3)}
    return _speed(lambda _, __: eso)(x, bench)


def _of_speed(
    law: str, tables: Callable[[Sequence[float], Bench], Tables], *free: tuple[float, float]
) -> Family:
    """The family of that name for a drive with a current loop of its own; one length in whole samples."""
    window = not free
    bounds = (_SPEED_POLE, *(free or _LENGTH[:1]))
    return Family(law, FAMILIES[law].doc, bounds, tables, (1,) if window else (), own_loop=True)


POSITION_SHARE: Final = 1.0 / 3.0
"""Pole of the angle over that of the speed."""
_SPEED_POLE: Final = (0.002, 0.4)
OWN_LOOP: Final[dict[str, Family]] = {
    family.law: family
    for family in (
        _of_speed("dob", _speed(_dob_channel), _GAMMA[0]),
        _of_speed("eso", _speed_eso, _GAMMA[0], (0.5, 1.0)),
        _of_speed("ftdob", _speed(_paper)),
        _of_speed("least-noise", _speed(_least)),
        _of_speed("cubic", _speed(_cubic)),
        _of_speed("exponentials", _speed(_three)),
        _of_speed("ramp-exact", _speed(_ramp)),
    )
}
"""The same for drives with a current loop of their own; the others command voltages, or need x_hat."""
OTHER_NAMES: Final[Mapping[str, str]] = {
    "kalman-lq": "kalman",
    "lqg": "kalman",
    "lq": "kalman",
    "cascade": "ftdob",
    "paper": "ftdob",
    "parabola": "least-noise",
    "least_noise": "least-noise",
    "ramp_exact": "ramp-exact",
}
DEFAULT_LAWS: Final = ("pi", "dob", "eso", "kalman", "ftdob", "least-noise", "cubic", "adaptive")


def family(name: str, own_loop: bool = False) -> Family:
    """The family of that name, for drives by voltage or with a loop of their own. Raises HilError."""
    known, law = OWN_LOOP if own_loop else FAMILIES, OTHER_NAMES.get(name, name)
    if law in known:
        return known[law]
    if law in FAMILIES:
        raise HilError(
            f"--laws: {law} is not for a drive with a current loop of its own; there are {', '.join(known)}"
        )
    if law in observers():
        raise HilError(
            f"--laws: {law} is a window that a configuration names (observer.speed.kind), none that is "
            f"tuned; there are {', '.join(known)}"
        )
    raise HilError(f"--laws: no law {name!r}; there are {', '.join(known)}")


def settings_of(tables: Tables) -> tuple[str, ...]:
    """The tables as settings of the config, inline TOML."""
    keys = {"controller": "controller", "speed": "observer.speed", "current": "observer.current"}
    return tuple(f"{keys[name]}={inline(table)}" for name, table in tables.items())


def inline(table: Mapping[str, Any]) -> str:
    """A table in one line of TOML."""
    return "{" + ", ".join(f"{key} = {_toml(value)}" for key, value in table.items()) + "}"


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else repr(float(value))


def toml(tables: Tables) -> str:
    """The tables as a piece of a config file."""
    names = {"controller": "controller", "speed": "observer.speed", "current": "observer.current"}
    parts = []
    for name, table in tables.items():
        lines = [f"{key} = {_toml(value)}" for key, value in table.items()]
        parts.append("\n".join([f"[{names[name]}]", *lines]))
    return "\n\n".join(parts) + "\n"
