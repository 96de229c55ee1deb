"""What goes wrong with a log, for both ends of it."""

from __future__ import annotations

from hil.errors import HilError


class LogError(HilError, OSError):
    """A log that can't be written or read; the message says where and what to do."""


class DamagedError(ValueError):
    """Bytes that are no valid MCAP; what precedes them is good. The reader turns it into ``Log.damage``."""


class UnknownCompressionError(DamagedError):
    """A chunk in a compression that is not known here; it may be good for another program."""
