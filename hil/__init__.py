"""Hardware-in-the-loop CAN drive controller with a fixed-time disturbance observer.

``hil.__all__`` is what notebooks and scripts may rely on; ``docs/api.md`` says what that promises. A name is
brought in when it is first asked for, so that ``import hil`` is light and changes nothing for others.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from hil.api.figures import metrics as metrics
    from hil.api.figures import plot as plot
    from hil.api.figures import report as report
    from hil.api.runs import emulator as emulator
    from hil.api.runs import replay as replay
    from hil.api.runs import run as run
    from hil.api.runs import simulate as simulate
    from hil.api.setups import build as build
    from hil.api.setups import load as load
    from hil.api.tuning import compare as compare
    from hil.api.tuning import design as design
    from hil.api.tuning import sweep as sweep
    from hil.campaign.run import campaign as campaign
    from hil.errors import ConfigError as ConfigError
    from hil.errors import HilError as HilError
    from hil.log.reader import open_log as open_log

_WHERE: Final = {
    "ConfigError": "hil.errors",
    "HilError": "hil.errors",
    "build": "hil.api.setups",
    "campaign": "hil.campaign.run",
    "compare": "hil.api.tuning",
    "design": "hil.api.tuning",
    "emulator": "hil.api.runs",
    "load": "hil.api.setups",
    "metrics": "hil.api.figures",
    "open_log": "hil.log.reader",
    "plot": "hil.api.figures",
    "replay": "hil.api.runs",
    "report": "hil.api.figures",
    "run": "hil.api.runs",
    "simulate": "hil.api.runs",
    "sweep": "hil.api.tuning",
}
__all__ = [
    "ConfigError", "HilError", "build", "campaign", "compare", "design", "emulator", "load", "metrics",
    "open_log", "plot", "replay", "report", "run", "simulate", "sweep",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """A public name, brought in when it is first asked for."""
    if name in _WHERE:
        return getattr(importlib.import_module(_WHERE[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Called(ModuleType):
    """A room of this package that is called as the public function of its name, as ``hil.replay``."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        """The public function."""
        return self.__wrapped__(*args, **options)

    @property
    def __wrapped__(self) -> Any:
        """The public function, for ``inspect.signature``."""
        name = self.__name__.rpartition(".")[2]
        return getattr(importlib.import_module(_WHERE[name]), name)


class _Package(ModuleType):
    """This package: importing one of its rooms does not take a public name away."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _WHERE and type(value) is ModuleType:
            value.__class__ = _Called
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
