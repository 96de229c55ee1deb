"""Words of error codes: CiA 402's own, else the class of CiA 301, else none."""

from __future__ import annotations

import pytest
from canopen.emcy import EmcyError

from hil.tick.errorcodes import CLASSES, CODES, words


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x2310, "0x2310, continuous over-current"),
        (0x8250, "0x8250, no RPDO in time"),
        (0x23FF, "0x23FF, current at the output"),
        (0x2FFF, "0x2FFF, current"),
        (0x8611, "0x8611, following error"),
        (0xFF42, "0xFF42, of the maker"),
        (0x0009, "0x0009"),
        (0xC000, "0xC000"),
    ],
)
def test_words(code: int, text: str) -> None:
    assert words(code) == text


def test_every_code_is_of_a_class_that_strangers_know_too() -> None:
    """canopen's table has the classes of CiA 301, of hardware and modules their first alone."""
    theirs = {0x2: "Current", 0x3: "Voltage", 0x4: "Temperature", 0x6: "Device Software", 0x8: "Monitoring"}
    for code in CODES:
        assert code >> 8 in CLASSES or code >> 8 & 0xF0 in CLASSES, hex(code)
        if code >> 12 in theirs:
            assert EmcyError(code, 0, b"", 0.0).get_desc() == theirs[code >> 12], hex(code)
