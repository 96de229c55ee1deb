"""The registry of laws and observers: what a member says of itself, and how its file is found.

A member is a module of ``hil.control.laws`` or ``hil.control.observers`` with a ``MEMBER``; a package of
somebody else's names one in the entry point group ``hil.laws`` or ``hil.observers``. From its keys follows
the table that the configuration accepts, from its design what the compiled tick runs.
"""

from __future__ import annotations

import functools
import importlib
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from hil.control.errors import ControlDesignError
from hil.control.fac import SampledModel
from hil.control.observer import Window

if TYPE_CHECKING:
    from hil.control.law import MotorModel

REQUIRED: Final = object()
"""Default of a key that must be given."""
Values = Mapping[str, Any]
"""A config table's keys and values, without ``kind``."""


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a member's table, its unit in its name; numbers are finite and above ``above``."""

    doc: str
    default: Any = REQUIRED
    type: Literal["number", "numbers", "flag", "i_d_table"] = "number"
    above: float | None = 0.0
    least: float | None = None
    most: float | None = None
    count: int = 3
    """Most entries of ``numbers``."""
    unit: str = ""
    """Unit, where the name does not end in it."""


JERK: Final = Key("feed the reference's jerk forward, as its slope is", False, type="flag")
"""Of the laws that can: ``jerk_feedforward``."""


def complete(given: Values, member: Observer | Law) -> dict[str, Any]:
    """The values that a design takes: what is given, without ``kind``, and the defaults of the rest."""
    defaults = {name: key.default for name, key in member.keys.items() if key.default is not REQUIRED}
    return defaults | {name: value for name, value in given.items() if name != "kind"}


@dataclass(frozen=True, slots=True)
class Channel:
    """What an observer's design is told: the channel (0 w, 1 q, 2 d), T_s [s], the joint sampled model."""

    index: int
    T_s: float
    model: SampledModel


@dataclass(frozen=True, slots=True)
class Observer:
    """An observer of one channel; one that needs all channels at once has ``joint`` instead."""

    kind: str
    doc: str
    keys: Mapping[str, Key]
    design: Callable[[Values, Channel], Window] | None = None
    joint: Callable[[Values, Values, SampledModel], Window] | None = None


@dataclass(frozen=True, slots=True)
class SpeedFilter:
    """What the drive does to the speed before it reports it: ``poles`` [rad/s], or a mean over ``ticks``.

    One pole: y' = p (w - y).  Two, as of a PLL: y'' + (p + q) y' + p q y = p q w.
    """

    poles: tuple[float, ...] = ()
    ticks: int = 0


@dataclass(frozen=True, slots=True)
class Shaft:
    """An elastic shaft between motor and load: ``resonance`` [rad/s], damping ratio, the motor's share of J.

    With twist t: J_l dw_l/dt = k t + c dt/dt - T_L, k = resonance^2 J_m J_l / J, c = 2 damping k / resonance.
    """

    resonance: float
    damping: float
    share: float

    @property
    def elastic(self) -> tuple[float, float, float]:
        """Resonance [Hz], damping ratio, the motor's share of J."""
        return self.resonance / (2.0 * math.pi), self.damping, self.share


@dataclass(frozen=True, slots=True)
class InnerLoop:
    """What a drive with a current loop of its own makes of a command u [A or N m].

    ``k_u``: torque per unit of u [N m]; ``u_i``: unit of u per ampere of i_q; ``lag`` [s]: time constant of
    the current loop; ``delay``: ticks by which a command acts later than with the next latch; ``told``: the
    drive reports i_q; ``filter``: what the speed comes through, None: nothing that the observer is to
    know; ``every``: ticks from one measurement to the next; ``shaft``: behind which the observer knows the
    load to be.
    """

    k_u: float
    u_i: float
    lag: float = 0.0
    delay: int = 0
    told: bool = True
    filter: SpeedFilter | None = None
    every: int = 1
    shaft: Shaft | None = None


@dataclass(frozen=True, slots=True)
class Plan:
    """What a law's design is told: the motor believed in, its sampled model, T_s [s], the drive's loop."""

    motor: MotorModel
    model: SampledModel
    T_s: float
    inner: InnerLoop | None = None


@dataclass(frozen=True, slots=True)
class Law:
    """A law: ``code`` selects its kernel in ``hil.control.law.command``; ``design`` yields parameters.

    ``takes``: what the drives take that it is for.
    """

    kind: str
    doc: str
    code: int
    design: Callable[[Values, Plan], dict[str, Any]]
    keys: Mapping[str, Key] = field(default_factory=dict)
    takes: tuple[str, ...] = ("voltage",)


_REGISTERED: Final[list[Any]] = []
"""What ``register`` took."""


def register(member: Observer | Law) -> None:
    """Add a member in this process alone, before anything reads a configuration.

    For a notebook or a trial; what is to run in the emulator's process, in workers and in a later replay
    is a package with an entry point. Raises ControlDesignError once the tables of the kinds are made.
    """
    if "hil.config.law" in sys.modules:
        raise ControlDesignError(f"kind {member.kind!r}: register it before the first configuration is read")
    _REGISTERED.append(member)
    observers.cache_clear()
    laws.cache_clear()


def _loaded(entry: EntryPoint) -> Any:
    """What an entry point names; what its package raises is said with its name."""
    try:
        return entry.load()
    except Exception as error:
        text = f"{entry.group}: {entry.name} = {entry.value}: {type(error).__name__}: {error}"
        raise ControlDesignError(text) from error


def _found(group: str, kind: Any) -> dict[str, Any]:
    """Members by kind: those of the folder in the order of their names, then those of other packages."""
    names = sorted(p.stem for p in Path(__file__).with_name(group).glob("*.py") if p.stem != "__init__")
    members = [importlib.import_module(f"hil.control.{group}.{name}").MEMBER for name in names]
    members += [_loaded(entry) for entry in entry_points(group=f"hil.{group}")]
    members += [member for member in _REGISTERED if isinstance(member, kind)]
    found: dict[str, Any] = {}
    for member in members:
        if not isinstance(member, kind) or member.kind in found:
            raise ControlDesignError(f"hil.{group}: {member!r} is no {kind.__name__} or its kind is taken")
        found[member.kind] = member
    return found


@functools.cache
def observers() -> dict[str, Observer]:
    """All observers by kind."""
    return _found("observers", Observer)


@functools.cache
def laws() -> dict[str, Law]:
    """All laws by kind."""
    return _found("laws", Law)


def member(kind: str, known: Mapping[str, Any]) -> Any:
    """The member of that kind. Raises ControlDesignError with those there are."""
    if kind not in known:
        raise ControlDesignError(f"kind {kind!r} is not one of {', '.join(known)}")
    return known[kind]
