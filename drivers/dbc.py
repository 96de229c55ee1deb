"""A DBC file as its statements: which message each belongs to, and the few attributes that are used.

cantools refuses a file as a whole for one odd message, and takes the longer the more there are. Here a file
is cut into statements first; cantools parses a message once it is asked for, with what belongs to it alone.
Attributes are read here, since other tools give them other types than cantools expects.
"""

from __future__ import annotations

import codecs
import re
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cantools

from drivers.errors import DatabaseError

MAX_DBC_BYTES: Final = 4 << 20
_BOMS: Final = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_HIDDEN: Final = re.compile(r'//[^\n]*|"(?:\\"|[^"])*"')
_STATEMENT: Final = re.compile(r"(?:^|(?<=;))[ \t]*([A-Z][A-Z_]*_|VERSION)(?=[ \t]*[: \t])", re.MULTILINE)
_MESSAGE: Final = re.compile(r"BO_\s+(\d+)\s+(\w+)\s*:")
_OF_MESSAGE: Final = re.compile(r"(?:SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d+)\s+(\w+)")
_ATTRIBUTE: Final = re.compile(
    r'BA_\s+"([^"]*)"\s+(?:BO_\s+(\d+)|SG_\s+(\d+)\s+(\w+))\s+("(?:\\"|[^"])*"|[^\s;]+)\s*;'
)
_DEFAULT: Final = re.compile(r'BA_DEF_DEF_\s+"([^"]*)"\s+("(?:\\"|[^"])*"|[^\s;]*)\s*;')
_CHOICES: Final = re.compile(r'BA_DEF_\s+(?:BO_|SG_)\s+"([^"]*)"\s+ENUM\s+([^;]*);')
_MULTIPLEXED: Final = re.compile(r"SG_\s+(\w+)\s+(m\d+M?|M)\s*:")
_FRAME_FORMATS: Final = ("StandardCAN", "ExtendedCAN", *["reserved"] * 12, "StandardCAN_FD", "ExtendedCAN_FD")
_NO_MESSAGE: Final = "VECTOR__INDEPENDENT_SIG_MSG"  # signals that belong to no frame


def read_text(path: Path) -> str:
    """A DBC's text: by its byte order mark, else UTF-8 where it is that, else Windows' western code page.

    Raises DatabaseError.
    """
    try:
        if path.stat().st_size > MAX_DBC_BYTES:
            raise DatabaseError(f"{path}: larger than {MAX_DBC_BYTES} bytes; this is no DBC")
        raw = path.read_bytes()
    except OSError as error:
        raise DatabaseError(f"{path}: can't be read: {error}") from error
    return decoded(raw)


def decoded(raw: bytes) -> str:
    """Text of a DBC's bytes; never fails: what no code page knows becomes Latin-1's."""
    for mark, encoding in _BOMS:
        if raw.startswith(mark):
            return raw[len(mark) :].decode(encoding, "replace")
    for encoding in ("utf-8", "cp1252"):
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            continue
    return raw.decode("latin-1")


@dataclass(slots=True)
class Block:
    """A message's statements: its own with its signals, and those of their kinds and multiplexers."""

    raw_id: int
    name: str
    own: list[str]
    more: list[tuple[str, str]] = field(default_factory=list)
    """(signal, statement)."""


class Statements:
    """The statements of a DBC by message. ``blocks``: by name, each as often as it is there."""

    def __init__(self, text: str) -> None:
        self.blocks: dict[str, list[Block]] = {}
        self._more: dict[int, list[tuple[str, str]]] = defaultdict(list)
        self._values: dict[tuple[str, int, str], str] = {}
        self._defaults: dict[str, str] = {}
        self._choices: dict[str, list[str]] = {}
        self._block: Block | None = None
        text = text.replace("\r\n", "\n").replace("\r", "\n")
        hidden = _HIDDEN.sub(lambda match: "\x01" * len(match[0]), text)
        starts = list(_STATEMENT.finditer(hidden))
        ends = [one.start() for one in starts[1:]] + [len(text)]
        for start, end in zip(starts, ends, strict=False):
            self._take(start[1], text[start.start(1) : end])
        self._name_long()

    def _take(self, keyword: str, statement: str) -> None:
        """Put a statement where it belongs; of those that say nothing about frames none is kept."""
        if keyword == "BO_" and (found := _MESSAGE.match(statement)):
            self._block = Block(int(found[1]), found[2], [statement])
            if found[2] != _NO_MESSAGE:
                self.blocks.setdefault(found[2], []).append(self._block)
        elif keyword == "SG_" and self._block is not None:
            self._block.own.append(statement)
        elif found := _OF_MESSAGE.match(statement):
            self._more[int(found[1])].append((found[2], statement))
        elif found := _ATTRIBUTE.match(statement):
            name, message, message_of, signal, value = found.groups()
            self._values[name, int(message or message_of), signal or ""] = value
        elif found := _DEFAULT.match(statement):
            self._defaults[found[1]] = found[2]
        elif found := _CHOICES.match(statement):
            self._choices[found[1]] = re.findall(r'"([^"]*)"', found[2])

    def _name_long(self) -> None:
        """Names over 32 characters stand in an attribute; the message is known by that."""
        for name, blocks in list(self.blocks.items()):
            for block in blocks:
                block.more = self._more.get(block.raw_id, [])
                long = self.attribute("SystemMessageLongSymbol", block.raw_id)
                if long and long != name:
                    block.name = long
                    self.blocks.setdefault(long, []).append(block)
                    self.blocks[name] = [one for one in self.blocks[name] if one is not block]
        self.blocks = {name: blocks for name, blocks in self.blocks.items() if blocks}

    def attribute(self, name: str, raw_id: int, signal: str = "", *, default: bool = True) -> str | None:
        """An attribute's value as text, that of an enumeration by its name; None for none."""
        value = self._values.get((name, raw_id, signal))
        if value is None:
            value = self._defaults.get(name) if default else None
        if value is None:
            return None
        if value.startswith('"'):
            return value[1:-1].replace('\\"', '"').strip()
        choices = self._choices.get(name, ())
        return choices[int(value)] if value.isdigit() and int(value) < len(choices) else value

    def number(self, name: str, raw_id: int, signal: str = "", *, default: bool = True) -> float | None:
        """An attribute that is a number, written as one or as a string; None for what is none."""
        text = self.attribute(name, raw_id, signal, default=default)
        try:
            return None if text is None else float(int(text, 0) if text.lower().startswith("0x") else text)
        except ValueError:
            return None

    def is_fd(self, raw_id: int) -> bool:
        """Is the frame a CAN FD one by its VFrameFormat?"""
        text = self.attribute("VFrameFormat", raw_id) or ""
        index = int(text) if text.isdigit() and "VFrameFormat" not in self._choices else -1
        return (_FRAME_FORMATS[index] if 0 <= index < len(_FRAME_FORMATS) else text).endswith("CAN_FD")


@dataclass(frozen=True, slots=True)
class Parsed:
    """A message as cantools parsed it, and the multiplexer mark of each signal that has one."""

    message: Any
    marks: dict[str, str]


def parse(block: Block, where: str) -> Parsed:
    """Parse one message. Raises DatabaseError with cantools' reason."""
    marks = {found[1]: found[2] for text in block.own if (found := _MULTIPLEXED.match(text))}
    known = {found[1] for text in block.own if (found := re.match(r"SG_\s+(\w+)", text))}
    extra = [statement for signal, statement in block.more if signal in known]
    if 0x7FF < block.raw_id < 0x80000000:
        raise DatabaseError(
            f"{where}: identifier 0x{block.raw_id:X} has more than 11 bits and is not marked as extended; "
            f"write {block.raw_id | 0x80000000} in the DBC"
        )
    text = "".join(block.own) + "\n" + "".join(extra)
    try:
        database: Any = cantools.database.load_string(text, database_format="dbc", strict=False)
        return Parsed(database.messages[0], marks)
    except Exception as error:
        raise DatabaseError(f"{where}: can't be read: {_lines(error)}") from error


def _lines(error: Exception) -> str:
    """An error's words in one line."""
    return " ".join(str(error).split()) or type(error).__name__
