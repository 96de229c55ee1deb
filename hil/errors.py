"""The small error tree of the controller: what a user can mend, said in one line with the remedy."""

from __future__ import annotations


class HilError(Exception):
    """Base of everything that is refused with one clear line and a non-zero exit code."""


class ConfigError(HilError, ValueError):
    """A configuration that can't be used; ``problems`` lists every mistake found."""

    def __init__(self, where: str, problems: list[str]) -> None:
        self.where = where
        self.problems = problems
        super().__init__("\n".join(f"{where}: {problem}" for problem in problems))


class ArmingError(HilError, RuntimeError):
    """Arming was refused; nothing has been sent."""


def plain(text: str) -> str:
    """Text from a log or a path for a terminal: control characters, which could command it, are replaced."""
    return "".join(c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text)
