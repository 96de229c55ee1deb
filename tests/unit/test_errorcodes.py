"""Words of error codes: CiA 402's own, else the class of CiA 301, else none."""

from __future__ import annotations

import canopen
import pytest
from canopen.emcy import EmcyError

from hil.tick.errorcodes import CLASSES, CODES, words
from tests.canopen import E35


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x2310, "0x2310, continuous over-current"),
        (0x8250, "0x8250, no RPDO in time"),
        (0x23FF, "0x23FF, current at the output"),
        (0x2FFF, "0x2FFF, current"),
        (0x8611, "0x8611, following error"),
        (0xFF42, "0xFF42, of the maker"),
        (0x2342, "0x2342, short circuit, V to W"),
        (0x5111, "0x5111, supply +/-15 V"),
        (0x5114, "0x5114, supply U4, of the maker"),
        (0x5119, "0x5119, supply U9, of the maker"),
        (0x5445, "0x5445, contact 5"),
        (0x5459, "0x5459, fuse 9"),
        (0x630F, "0x630F, data record 15"),
        (0x6310, "0x6310, loss of parameters"),
        (0x7307, "0x7307, incremental encoder 3"),
        (0x8230, "0x8230, MPDO to an object that is not there"),
        (0x4300, "0x4300, drive temperature"),
        (0x4400, "0x4400, supply temperature"),
        (0x0009, "0x0009"),
        (0xC000, "0xC000"),
    ],
)
def test_words(code: int, text: str) -> None:
    assert words(code) == text


def test_two_codes_of_one_class_have_words_of_their_own() -> None:
    """CiA 402-2's codes whose names are the same are of two classes."""
    said = [(code >> 12, text) for code, text in CODES.items()]
    assert len(said) == len(set(said))


def test_no_eds_has_words_for_a_code() -> None:
    """A servo maker's whole EDS names the objects that carry one: CiA 306 has room for no more."""
    objects = canopen.import_od(str(E35))
    assert {objects[index].name for index in (0x1003, 0x1014, 0x603F)} == {
        "Pre-defined Error Field", "COB-ID Emergency message", "Error code",
    }  # fmt: skip


def test_every_code_is_of_a_class_that_strangers_know_too() -> None:
    """canopen's table has the classes of CiA 301, of hardware and modules their first alone."""
    theirs = {0x2: "Current", 0x3: "Voltage", 0x4: "Temperature", 0x6: "Device Software", 0x8: "Monitoring"}
    for code in CODES:
        assert code >> 8 in CLASSES or code >> 8 & 0xF0 in CLASSES, hex(code)
        if code >> 12 in theirs:
            assert EmcyError(code, 0, b"", 0.0).get_desc() == theirs[code >> 12], hex(code)
