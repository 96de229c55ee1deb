"""Values of a plan: distributions as the inverse of their distribution function, and TOML text of a value.

A draw is u in (0, 1) pushed through :meth:`Distribution.at`, so that random numbers, a Latin hypercube and
Sobol's sequence share one form, and a case is the same to the bit alone and in its campaign.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, Final, Literal

from hil.campaign.normal import between, normal

Kind = Literal["uniform", "loguniform", "normal", "integers", "choice"]
NAMES: Final[dict[str, Kind]] = {
    "uniform": "uniform",
    "loguniform": "loguniform",
    "log-uniform": "loguniform",
    "log_uniform": "loguniform",
    "normal": "normal",
    "gaussian": "normal",
    "integers": "integers",
    "integer": "integers",
    "choice": "choice",
    "list": "choice",
    "values": "choice",
}
FORMS: Final = (
    "{ uniform = [low, high] }, { loguniform = [low, high] }, { normal = [mean, sd] }, "
    "{ integers = [low, high] }, { choice = [...] }, or { percent = p } about the config's own value"
)
FIRST: Final = ("low", "min", "minimum", "lower", "mean", "mu", "loc", "a")
SECOND: Final = ("high", "max", "maximum", "upper", "sd", "std", "sigma", "scale", "stddev", "stdev", "b")


@dataclass(frozen=True, slots=True)
class Distribution:
    """One key's distribution; ``values`` are (low, high), (mean, sd), or the values to choose from."""

    kind: Kind
    values: tuple[Any, ...]

    def at(self, u: float) -> Any:
        """The value below which a share ``u`` of all draws lies, 0 < u < 1."""
        if self.kind == "choice":
            return self.values[min(int(u * len(self.values)), len(self.values) - 1)]
        a, b = self.values
        if self.kind == "normal":
            return float(a + b * normal(u))
        if self.kind == "loguniform":
            return between(a, b, u)
        if self.kind == "integers":
            return min(int(a + u * (b - a + 1)), int(b))
        return float(a + u * (b - a))

    def probes(self) -> list[Any]:
        """Values that show whether the key can be set: the middle, and both ends."""
        return list(self.values) if self.kind == "choice" else [self.at(u) for u in (0.5, 1e-9, 1.0 - 1e-9)]


def number(value: Any, what: str) -> float:
    """A finite number. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{what} must be a finite number, not {value!r}")
    return float(value)


def pair(value: Any, what: str) -> tuple[float, float]:
    """Two finite numbers. Raises ValueError."""
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"{what} needs two numbers, not {value!r}")
    return number(value[0], what), number(value[1], what)


def distribution(given: Any, own: Any) -> Distribution:
    """A distribution from a plan's entry; ``own``: the config's value. Raises ValueError."""
    if isinstance(given, list):
        numeric = len(given) == 2 and not any(isinstance(v, bool | str | dict | list) for v in given)
        return _checked("uniform" if numeric else "choice", given)
    if isinstance(given, str) and given.strip().endswith("%"):
        given = {"percent": _percent(given)}
    if not isinstance(given, dict):
        raise ValueError(f"{given!r} is no distribution; there are {FORMS}")
    if "percent" in given:
        return _relative(given, own)
    kind, values = _read(dict(given))
    return _checked(kind, values)


def _read(given: dict[str, Any]) -> tuple[Kind, Any]:
    """Kind and values of a table in one of its forms."""
    for name in ("kind", "dist", "distribution", "type"):
        if name in given:
            word = given.pop(name)
            break
    else:
        if len(given) != 1:
            raise ValueError(f"{given!r} is no distribution; there are {FORMS}")
        word, inner = next(iter(given.items()))
        given = inner if isinstance(inner, dict) else {"values": inner}
    kind = NAMES.get(str(word).lower())
    if kind is None:
        raise ValueError(f"{word!r} is no distribution; there are {FORMS}")
    return kind, _values(kind, given)


def _values(kind: Kind, given: dict[str, Any]) -> Any:
    for name in ("values", "range", "choices", "of", "params", "parameters"):
        if set(given) == {name}:
            return given[name]
    first, second = ([n for n in names if n in given] for names in (FIRST, SECOND))
    if len(first) != 1 or len(second) != 1 or len(given) != 2:
        raise ValueError(f"{kind} takes two numbers, not {given!r}; there are {FORMS}")
    return [given[first[0]], given[second[0]]]


def _checked(kind: Kind, values: Any) -> Distribution:
    """Refuse what no distribution can be."""
    if kind == "choice":
        if not isinstance(values, list) or not values:
            raise ValueError(f"choice needs a list of values, not {values!r}")
        return Distribution(kind, tuple(values))
    a, b = pair(values, kind)
    if kind == "normal" and not b > 0:
        raise ValueError(f"normal needs a standard deviation above 0, not {b:g}")
    if kind in ("uniform", "loguniform") and not a < b:
        raise ValueError(f"{kind} needs low < high, not {a:g} and {b:g}")
    if kind == "loguniform" and not a > 0:
        raise ValueError(f"loguniform needs low above 0, not {a:g}")
    if kind == "integers" and not (a.is_integer() and b.is_integer() and a <= b):
        raise ValueError(f"integers needs whole numbers low <= high, not {a:g} and {b:g}")
    return Distribution(kind, (a, b))


def _percent(text: str) -> float:
    try:
        return float(text.strip().rstrip("%").strip().lstrip("±+-"))
    except ValueError:
        raise ValueError(f"{text!r} is no percentage") from None


def _relative(given: dict[str, Any], own: Any) -> Distribution:
    """``percent`` about the config's own value: ends of a range, or standard deviation of a normal."""
    share = abs(span(given["percent"], own))
    kinds = [given[name] for name in ("kind", "dist", "distribution", "type") if name in given]
    kind = NAMES.get(str(kinds[0]).lower() if kinds else "uniform")
    if kind not in ("uniform", "normal") or len(given) > 1 + len(kinds):
        raise ValueError(f"{given!r}: percent goes with uniform or normal alone")
    return _checked(kind, [own - share, own + share] if kind == "uniform" else [own, share])


def span(percent: Any, own: Any) -> float:
    """``percent`` of the config's own value. Raises ValueError."""
    share = _percent(percent) if isinstance(percent, str) else number(percent, "percent")
    if not share > 0:
        raise ValueError(f"percent must be above 0, not {share:g}")
    if own is None:
        raise ValueError("the config has no such key to be about; is it spelt right?")
    if isinstance(own, bool) or not isinstance(own, int | float) or own == 0:
        raise ValueError("a percentage needs a value of the config other than 0 to be about")
    return float(own) * share / 100.0


def corners(given: Any, own: Any) -> tuple[Any, ...]:
    """The values of a corner: low and high. Raises ValueError."""
    if isinstance(given, str) and given.strip().endswith("%"):
        given = {"percent": _percent(given)}
    if isinstance(given, dict) and set(given) == {"percent"}:
        half = span(given["percent"], own)
        return (own - half, own + half)
    if isinstance(given, dict):
        first, second = ([n for n in names if n in given] for names in (FIRST, SECOND))
        if len(first) != 1 or len(second) != 1 or len(given) != 2:
            raise ValueError(f"{given!r} is no corner; there are [low, high], {{ low, high }}, {{ percent }}")
        given = [given[first[0]], given[second[0]]]
    if not isinstance(given, list) or len(given) < 2:
        raise ValueError(f"{given!r} is no corner; there are [low, high], {{ low, high }}, {{ percent }}")
    numeric = all(isinstance(v, int | float) and not isinstance(v, bool) for v in given)
    if numeric and (not all(math.isfinite(v) for v in given) or sorted(set(given)) != list(given)):
        raise ValueError(f"a corner needs finite low < high, not {given!r}")
    return tuple(given)


def toml(value: Any) -> str:
    """A value as TOML, exact: what ``--set KEY=`` takes."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return repr(value)
