"""Hardware-in-the-loop CAN drive controller with a fixed-time disturbance observer."""

from __future__ import annotations

from typing import Any

__all__ = ["open_log"]


def __getattr__(name: str) -> Any:
    """``hil.open_log``, brought in when it is first asked for, so that ``import hil`` stays light."""
    if name == "open_log":
        from hil.log.reader import open_log

        return open_log
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
