"""Errors of the bus and the codec; each has the standard library's type as second parent."""

from __future__ import annotations


class DriverError(Exception):
    """Base of all errors of this package."""


class LinkError(DriverError, OSError):
    """The bus can't be used."""


class LinkDown(LinkError):
    """The interface is down or gone; nothing more is sent on this link."""


class QueueFull(LinkError):
    """The transmit queue is full: the bus does not take what is sent (ENOBUFS)."""


class DatabaseError(DriverError, ValueError):
    """A DBC that can't be used: names file, message, signal and remedy."""


class EncodeError(DriverError, ValueError):
    """A value that does not fit its signal. Toward an actuator this stops; it is never replaced."""


class DecodeError(DriverError, ValueError):
    """A frame that can't be applied whole."""


class NodeError(DriverError, RuntimeError):
    """A CANopen node that is silent, refuses an object, or holds another value than it was given."""
