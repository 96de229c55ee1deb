"""Recordings of other tools, dialect by dialect: what a line is; nothing becomes a data frame."""

from __future__ import annotations

import gzip
import io
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hil.exchange.export import export
from hil.exchange.readers.recorded import ERROR, EXTENDED, REMOTE, Recorded
from hil.exchange.recording import Recording, kinds_of
from hil.log.errors import LogError
from hil.log.schema import FRAME, Records
from tests.logfiles import some_ticks, write_log

pytestmark = pytest.mark.slow

T_NS = 1_795_758_784_904_425_000
STAMP = "(1795758784.904425)"
EIGHT = bytes(range(0x11, 0x99, 0x11))
BUS_ERROR = bytes.fromhex("0000080000000000")


def recording(path: Path, text: str | bytes, **more: Any) -> Recording:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return Recording(path, **more)


CANDUMP: dict[str, Recorded] = {
    "181#1122334455667788": Recorded(T_NS, "can0", 0x181, True, False, EIGHT),
    "181#1122334455667788 R": Recorded(T_NS, "can0", 0x181, True, False, EIGHT),
    "181#11.22.33.44.55.66.77.88 T": Recorded(T_NS, "can0", 0x181, False, False, EIGHT),
    "080#": Recorded(T_NS, "can0", 0x80, True, False, b""),
    "00000080# T": Recorded(T_NS, "can0", EXTENDED | 0x80, False, False, b""),
    "1FFFFFFF#00": Recorded(T_NS, "can0", EXTENDED | 0x1FFFFFFF, True, False, b"\0"),
    "20000080#0000080000000000 R": Recorded(T_NS, "can0", ERROR | 0x80, True, False, BUS_ERROR),
    "20000004#0030000000008888": Recorded(
        T_NS, "can0", ERROR | 4, True, False, bytes.fromhex("0030000000008888")
    ),
    "20000204#0000080000000000": Recorded(T_NS, "can0", ERROR | 0x204, True, False, BUS_ERROR),
    "123#R": Recorded(T_NS, "can0", REMOTE | 0x123, True, False, b""),
    "123#R5 T": Recorded(T_NS, "can0", REMOTE | 0x123, False, False, bytes(5)),
    "12345678#R8": Recorded(T_NS, "can0", EXTENDED | REMOTE | 0x12345678, True, False, bytes(8)),
    "7A0#1122334455667788_C R": Recorded(T_NS, "can0", 0x7A0, True, False, EIGHT),
    "123#R8_F": Recorded(T_NS, "can0", REMOTE | 0x123, True, False, bytes(8)),
    "123##1112233445566778899AABBCC": Recorded(T_NS, "can0", 0x123, True, True, EIGHT + b"\x99\xaa\xbb\xcc"),
    "123##311 R": Recorded(T_NS, "can0", 0x123, True, True, b"\x11"),
    "123##0": Recorded(T_NS, "can0", 0x123, True, True, b""),
    "123#112233445566778899AABBCC": Recorded(T_NS, "can0", 0x123, True, True, EIGHT + b"\x99\xaa\xbb\xcc"),
}


@pytest.mark.parametrize("body", list(CANDUMP))
def test_a_line_of_candump(tmp_path: Path, body: str) -> None:
    found = recording(tmp_path / "a.log", f"{STAMP} can0 {body}\n")
    assert list(found.frames()) == [CANDUMP[body]] and found.damage is None


UNREADABLE = [
    f"{STAMP} can0 181#112",
    f"{STAMP} can0 181#112233445566778899",
    f"{STAMP} can0 181#11223344556677889900112233",
    f"{STAMP} can0 8FF#11",
    f"{STAMP} can0 81#11",
    f"{STAMP} can0 E0000080#11",
    f"{STAMP} can0 20000080#R4",
    f"{STAMP} can0 123#R9",
    f"{STAMP} can0 181",
    f"{STAMP} can0 181##",
    f"{STAMP} can0 181#xx",
    "(nan) can0 181#11",
    "(inf) can0 181#11",
    "(1e300) can0 181#11",
    "(-1.000000) can0 181#11",
    "(99999999999.000000) can0 181#11",
    "can0 181#11",
    "\x00\xff no frame",
]


@pytest.mark.parametrize("line", UNREADABLE)
def test_a_line_that_is_no_frame_is_missed_with_its_place(tmp_path: Path, line: str) -> None:
    text = f"{STAMP} can0 181#11\n{line}\n{STAMP} can0 181#22\n"
    with pytest.raises(
        LogError, match=r"1 of 3 lines can't be read \(line 2: .*--partial takes the 2 frames"
    ):
        recording(tmp_path / "a.log", text)
    found = recording(tmp_path / "a.log", text, partial=True)
    assert [one.data for one in found.frames()] == [b"\x11", b"\x22"] and found.damage is not None


OTHER_FORMATS = {
    "screen": ("  can0  181   [8]  11 22 33 44 55 66 77 88\n", "what candump prints on the screen"),
    "screen with stamps": (f"{STAMP}  can0  181   [2]  11 22\n", "what candump prints on the screen"),
    "screen with -x": (f" {STAMP}  can0  RX - -  181   [2]  11 22\n", "what candump prints on the screen"),
    "screen, error": ("  can0  20000080   [8]  00 00 08 00 00 00 00 00   ERRORFRAME\n", "on the screen"),
    "screen, remote": ("  can0  123   [0]  remote request\n", "on the screen"),
    "BUSMASTER": ("***BUSMASTER Ver 3.2.2***\n***PROTOCOL CAN***\n", "a log of BUSMASTER"),
    "asc": ("date Fri Nov 27 08:26:00.045 2026\nbase hex\n", "name it .asc"),
    "text": ("hello world\n", "it begins 'hello world'"),
}


@pytest.mark.parametrize("case", list(OTHER_FORMATS))
def test_what_is_no_log_of_candump_is_called_by_its_name(tmp_path: Path, case: str) -> None:
    text, said = OTHER_FORMATS[case]
    with pytest.raises(LogError, match=f"not a candump -l log.*{said}"):
        recording(tmp_path / "a.log", text, partial=True)


ASC_HEAD = "date Fri Nov 27 08:26:00.045 2026\nbase hex  timestamps absolute\ninternal events logged\n"
ASC: dict[str, tuple[int, bool, bool, bytes] | None] = {
    "1  181             Rx   d 8 11 22 33 44 55 66 77 88": (0x181, True, False, EIGHT),
    "1  181             Tx   d 2 11 22  Length = 0 BitCount = 0": (0x181, False, False, b"\x11\x22"),
    "1  80              Tx   d 0": (0x80, False, False, b""),
    "1  12345678x       Rx   d 1 FF": (EXTENDED | 0x12345678, True, False, b"\xff"),
    "1  123             Rx   r": (REMOTE | 0x123, True, False, b""),
    "1  123             Rx   r 5": (REMOTE | 0x123, True, False, bytes(5)),
    "1  123             Rx   r 5 Length = 0": (REMOTE | 0x123, True, False, bytes(5)),
    "1  7A0             Rx   d C 11 22 33 44 55 66 77 88": (0x7A0, True, False, EIGHT),
    "1  ErrorFrame": (ERROR | 0x80, True, False, bytes(8)),
    "1  ErrorFrame\tFlags = 0xe CodeExt = 0x20a2 Code = 0x82 ID = 0 DLC = 0": (
        ERROR | 0x80, True, False, bytes(8),
    ),
    "CANFD   1 Rx   ErrorFrame   Not Acknowledge error, dominant error flag": (
        ERROR | 0x80, True, False, bytes(8),
    ),
    "CANFD   1 Rx        123                                   1 0 9 12 "
    "11 22 33 44 55 66 77 88 99 AA BB CC   130000  130     3000 0 0 0 0 0": (
        0x123, True, True, EIGHT + b"\x99\xaa\xbb\xcc",
    ),
    "CANFD   1 Tx   123x  EngineData   0 1 1  1 11   130000  130     5000 0 0 0 0 0": (
        EXTENDED | 0x123, False, True, b"\x11",
    ),
    "CANFD   1 Rx        123                                   0 0 0  0   0  0  1000 0 0 0 0 0": (
        0x123, True, True, b"",
    ),
    "CANFD   1 Rx        181                                   0 0 2  2 11 22   0  0  0 0 0 0 0 0": (
        0x181, True, False, b"\x11\x22",
    ),
    "CANFD   1 Rx        123                                   0 0 4  0   0  0  10 0 0 0 0 0": (
        REMOTE | 0x123, True, False, bytes(4),
    ),
    "1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%": None,
    "CAN 1 Status:chip status error active": None,
    "1  181             TxRq d 2 11 22": None,
    "Start of measurement": None,
}  # fmt: skip


@pytest.mark.parametrize("body", list(ASC))
def test_a_line_of_asc(tmp_path: Path, body: str) -> None:
    text = f"{ASC_HEAD}   0.500000 {body}\n   0.600000 1  7FF   Rx   d 0\n"
    found = [tuple(one) for one in recording(tmp_path / "a.asc", text).frames()]
    start_ns = int(datetime(2026, 11, 27, 8, 26).timestamp()) * 10**9 + 45_000_000
    last = (start_ns + 600_000_000, "0", 0x7FF, True, False, b"")
    wanted = ASC[body]
    assert found == ([] if wanted is None else [(start_ns + 500_000_000, "0", *wanted)]) + [last]


def test_an_asc_file_without_its_end_says_so(tmp_path: Path) -> None:
    found = recording(tmp_path / "a.asc", f"{ASC_HEAD}Begin Triggerblock x\n 0.1 1 181 Rx d 1 11\n")
    assert found.count == 1 and any("may be cut off" in note for note in found.notes)


@pytest.mark.parametrize(
    "last", [f"{STAMP} can0 181#22", f"{STAMP} can0 181#1122 ", f"{STAMP} can0 1", f"{STAMP} can0 181#112"]
)
def test_a_last_line_that_is_cut_off_is_no_shorter_frame(tmp_path: Path, last: str) -> None:
    directed = " R" if last.endswith(" ") else ""
    with pytest.raises(LogError, match=r"1 of 2 lines can't be read \(line 2: "):
        recording(tmp_path / "a.log", f"{STAMP} can0 181#1122{directed}\n{last}")
    assert recording(tmp_path / "a.log", f"{STAMP} can0 181#1122\n{STAMP} can0 181#3344").count == 2


def test_a_clock_that_stands_still_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="its 100 stamps are all the same"):
        recording(tmp_path / "a.log", f"{STAMP} can0 181#11\n" * 100)


def test_asc_in_decimal_and_with_relative_times() -> None:
    """Distances run over every line with a time, of whatever kind."""
    from hil.exchange.readers import asc
    from hil.exchange.readers.recorded import Found

    text = (
        "date Fre Mär 27 01:02:03 pm 2026\nbase dec  timestamps relative\n"
        "Begin Triggerblock Fre Mär 27 01:02:03 pm 2026\n   0.000000 Start of measurement\n"
        "   0.001000 1  128  Tx d 0\n   0.000500 1 Statistic: D 0\n   0.000100 1  385 Rx d 2 17 255\n"
        "   0.000400 1  513 TxRq d 0\n   0.000100 1  513 Tx d 0\nEnd TriggerBlock\n"
    )
    start_ns = int(datetime(2026, 3, 27, 13, 2, 3).timestamp()) * 10**9
    found = Found()
    frames = list(asc.read(io.StringIO(text), found))
    assert [(one.t_ns - start_ns, one.can_id, one.data) for one in frames] == [
        (1_000_000, 0x80, b""), (1_600_000, 0x181, b"\x11\xff"), (2_100_000, 0x201, b""),
    ]  # fmt: skip
    assert found.damage is None and sum(found.notes.values()) == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{ASC_HEAD} 0.1 1 181 Rx d 8 11 22\n", "2 of 8 bytes are there"),
        (f"{ASC_HEAD} 0.1 1 EngineData Rx d 1 11\n", "is no number of base 16"),
        (f"{ASC_HEAD} 0.1 1 FFF Rx d 1 11\n", "FFF is no 11-bit identifier"),
        (f"{ASC_HEAD} 0.1 1 181 Rx d 1 1FF\n", "are no bytes"),
        (f"{ASC_HEAD} 0.1 CANFD 1 Rx 181 1 0 9 12 11\n", "of 12 bytes are there"),
        (
            f"{ASC_HEAD} 0.1 1 181 Rx d 1 11\n 0.2 1 18",
            "in the middle of a line",
        ),
        (" 0.1 1 181 Rx d 1 11\n", "not an ASC file"),
        ("", "has no frames"),
    ],
)
def test_what_is_wrong_with_an_asc_file(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(LogError, match=said):
        recording(tmp_path / "a.asc", text)


# fmt: off
TRC: dict[str, tuple[str, list[tuple[int, bool, bool, bytes]]]] = {
    "1.0": (
        "     1)  1841     0001 8 11 22 33 44 55 66 77 88\n"
        "     2)  1842 00000080 1 FF\n     3)  1843 0123 3 RTR\n",
        [(1, True, False, EIGHT), (EXTENDED | 0x80, True, False, b"\xff"),
         (REMOTE | 0x123, True, False, bytes(3))],
    ),
    "1.1": (
        ";$FILEVERSION=1.1\n;$STARTTIME=46353.5\n"
        "  1)   1.5  Tx  0080  0 \n  2) 2.5 Rx 0181 2 11 22\n"
        "  3) 3.0 Error 0008 4 01 19 08 09\n  4) 4.0 Warng FFFFFFFF 4 00 00 00 08 BUSHEAVY\n"
        "  5) 5.0 Rx 0123 4 RTR\n",
        [
            (0x80, False, False, b""), (0x181, True, False, b"\x11\x22"),
            (ERROR | 0x88, True, False, bytes((0, 0, 1, 0, 0, 0, 9, 8))),
            (REMOTE | 0x123, True, False, bytes(4)),
        ],
    ),
    "1.3": (
        ";$FILEVERSION=1.3\n;$STARTTIME=46353.5\n  1) 1.5 1 Rx 0181 - 2 11 22\n"
        "  2) 2.5 1 Tx 00000201 - 1 FF\n",
        [(0x181, True, False, b"\x11\x22"), (EXTENDED | 0x201, False, False, b"\xff")],
    ),
    "2.1": (
        ";$FILEVERSION=2.1\n;$STARTTIME=46353.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"
        "  1 1.5 DT 1 0181 Rx - 2 11 22\n  2 2.5 FB 1 0123 Rx - 9 11 22 33 44 55 66 77 88 99 AA BB CC\n"
        "  3 3.5 RR 1 0123 Rx - 5\n  4 4.0 ST 1 - Rx - 4 00 00 00 00\n  5 4.5 ER 1 - Rx - 5 04 00 02 07 06\n",
        [
            (0x181, True, False, b"\x11\x22"), (0x123, True, True, EIGHT + b"\x99\xaa\xbb\xcc"),
            (REMOTE | 0x123, True, False, bytes(5)),
            (ERROR | 0x88, True, False, bytes((0, 0, 4, 0, 0, 0, 6, 7))),
        ],
    ),
    "2.0": (
        ";$FILEVERSION=2.0\n;$STARTTIME=46353.5\n;$COLUMNS=N,O,T,I,d,l,D\n"
        "  1 1.5 FD 0123 Tx 12 11 22 33 44 55 66 77 88 99 AA BB CC\n",
        [(0x123, False, True, EIGHT + b"\x99\xaa\xbb\xcc")],
    ),
}
# fmt: on


@pytest.mark.parametrize("version", list(TRC))
def test_traces_of_peak(tmp_path: Path, version: str) -> None:
    text, wanted = TRC[version]
    found = recording(tmp_path / "a.trc", text)
    assert [tuple(one)[2:] for one in found.frames()] == wanted
    if version != "1.0":
        noon = datetime(2026, 11, 27, 12, tzinfo=UTC).timestamp()
        assert found.start_ns == int(noon) * 10**9 + 1_500_000


def odd_frames() -> Records:
    """One of each kind that a log can hold, with every class of error that reads like an identifier."""
    kinds = [
        (0x80, 1), (0x181, 8), (EXTENDED | 0x80, 3), (0x201, 12), (REMOTE | 0x181, 0), (REMOTE | 0x181, 8),
        (EXTENDED | REMOTE | 0x12345678, 5), (ERROR | 0x80, 8), (ERROR | 0x204, 8), (ERROR | 4, 8),
        (ERROR | 0x1FF, 8),
        (ERROR | 0x20000 | 0x88, 8), (EXTENDED | 0x1FFFFFFF, 64), (0x7FF, 0),
    ]  # fmt: skip
    frames = np.zeros(len(kinds), FRAME)
    frames["t_ns"], frames["received"] = np.arange(len(kinds)) * 250_000, 1
    frames["can_id"], frames["size"] = zip(*kinds, strict=True)
    frames["received"][[0, 3, 4]] = 0
    filled = (np.arange(64) < frames["size"][:, None]) & ((frames["can_id"] & REMOTE) == 0)[:, None]
    frames["data"] = np.where(filled, np.arange(1, 65), 0)
    return frames


@pytest.mark.parametrize(
    "ending", [".log", ".asc", ".blf", ".mf4", ".log.gz", ".asc.gz", ".blf.gz", ".mf4.gz"]
)
def test_every_kind_of_frame_survives_every_format(tmp_path: Path, ending: str) -> None:
    frames = odd_frames()
    write_log(tmp_path / "run.mcap", some_ticks(10), frames)
    plain = tmp_path / f"a{ending.removesuffix('.gz')}"
    export(tmp_path / "run.mcap", plain, frames=True)
    if ending.endswith(".gz"):
        (tmp_path / f"a{ending}").write_bytes(gzip.compress(plain.read_bytes()))
    found = list(Recording(tmp_path / f"a{ending}").frames())
    wanted = [
        (int(f["can_id"]), bool(f["received"]), bytes(f["data"][: f["size"]]), bool(f["size"] > 8))
        for f in frames
    ]
    assert [(one.can_id, one.received, one.data, one.fd) for one in found] == wanted
    assert [one.t_ns - found[0].t_ns for one in found] == frames["t_ns"].tolist()


@pytest.mark.parametrize(
    ("ending", "reader"),
    [
        (".log", can.CanutilsLogReader),
        (".asc", can.ASCReader),
        (".blf", can.BLFReader),
        (".mf4", can.MF4Reader),
    ],
)
def test_others_see_no_data_frame_in_what_is_none(tmp_path: Path, ending: str, reader: Any) -> None:
    """python-can's readers, of what we wrote; its candump reader knows error frames of bus errors alone."""
    frames = odd_frames()
    if ending == ".log":
        frames = frames[((frames["can_id"] & ERROR) == 0) | ((frames["can_id"] & 0x80) != 0)]
    write_log(tmp_path / "run.mcap", some_ticks(10), frames)
    export(tmp_path / "run.mcap", tmp_path / f"a{ending}", frames=True)
    with reader(tmp_path / f"a{ending}") as messages:
        kinds = [(m.is_error_frame, m.is_remote_frame) for m in messages]
    wanted = [(bool(i & ERROR), bool(i & REMOTE)) for i in frames["can_id"].tolist()]
    assert kinds == wanted


def test_a_candump_line_of_ours_is_canplayers(tmp_path: Path) -> None:
    write_log(tmp_path / "run.mcap", some_ticks(10), odd_frames()[4:9])
    export(tmp_path / "run.mcap", tmp_path / "a.log")
    bodies = [line.split()[2:] for line in (tmp_path / "a.log").read_text().splitlines()]
    assert bodies == [
        ["181#R", "T"], ["181#R8", "R"], ["12345678#R5", "R"],
        ["20000080#0102030405060708", "R"], ["20000204#0102030405060708", "R"],
    ]  # fmt: skip


def messages(count: int) -> list[can.Message]:
    return [
        can.Message(
            timestamp=1_795_758_784.0 + at * 1e-3, arbitration_id=0x181, is_extended_id=False, data=[at % 256]
        )
        for at in range(count)
    ]  # fmt: skip


def written(path: Path, sent: list[can.Message], **options: Any) -> Path:
    with can.Logger(str(path), **options) as writer:
        for message in sent:
            writer(message)
    return path


def test_a_blf_file_out_of_order_is_ordered_and_says_so(tmp_path: Path) -> None:
    sent = messages(40)
    written(tmp_path / "a.blf", [*sent[:10], *sent[20:30], *sent[10:20], *sent[30:]])
    found = Recording(tmp_path / "a.blf")
    assert [one.data[0] for one in found.frames()] == list(range(40))
    assert found.notes == ["1 times the stamps go back, by 0.019 s at most: ordered by time"]


@pytest.mark.corners
@pytest.mark.parametrize("share", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("ending", [".blf", ".mf4", ".log.gz"])
def test_a_file_cut_off_says_how_much_is_missing(tmp_path: Path, ending: str, share: float) -> None:
    path = written(tmp_path / f"a{ending}", messages(20_000))
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(LogError, match=r"cut off|damaged") as refused:
        Recording(path)
    assert "\n" not in str(refused.value)
    if ending == ".blf":
        assert "bytes are missing" in str(refused.value)


@pytest.mark.parametrize("ending", [".log", ".asc", ".blf", ".mf4", ".trc", ".blf.gz", ".mf4.gz", ".log.gz"])
@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b"LOGG", b"MDF     4.10", b"no recording\n" * 9])
def test_an_empty_or_foreign_file_is_one_line(
    tmp_path: Path, ending: str, content: bytes, capfd: Any
) -> None:
    with pytest.raises(LogError) as refused:
        recording(tmp_path / f"a{ending}", content)
    assert "\n" not in str(refused.value) and str(tmp_path) in str(refused.value)
    assert capfd.readouterr() == ("", "")


def test_mf4_without_the_member_ide(tmp_path: Path) -> None:
    """By ASAM's bus logging IDE may be left out: the identifier's own bit 31, or its size, tells."""
    import asammdf

    fields = [
        ("CAN_DataFrame.ID", "<u4"),
        ("CAN_DataFrame.DataLength", "u1"),
        ("CAN_DataFrame.DataBytes", "u1", (8,)),
    ]
    rows = np.zeros(4, np.dtype(fields))
    rows["CAN_DataFrame.ID"], rows["CAN_DataFrame.DataLength"] = [0x80, 0x181, 0x80000080, 0x18FEF100], 2
    source = asammdf.blocks.v4_blocks.SourceInformation(source_type=2, bus_type=2)
    with asammdf.MDF(version="4.10") as file:
        file.append(asammdf.Signal(rows, np.array([0.0, 0.1, 0.2, 0.3]), name="CAN_DataFrame", source=source))
        file.save(tmp_path / "a.mf4")
    found = [one.can_id for one in Recording(tmp_path / "a.mf4").frames()]
    assert found == [0x80, 0x181, EXTENDED | 0x80, EXTENDED | 0x18FEF100]


@pytest.mark.parametrize("stamp", [float("nan"), float("inf"), 1e300])
def test_stamps_that_are_no_time_are_missed(tmp_path: Path, stamp: float) -> None:
    import asammdf

    fields = [
        ("CAN_DataFrame.ID", "<u4"),
        ("CAN_DataFrame.DataLength", "u1"),
        ("CAN_DataFrame.DataBytes", "u1", (8,)),
    ]
    source = asammdf.blocks.v4_blocks.SourceInformation(source_type=2, bus_type=2)
    rows = np.zeros(3, np.dtype(fields))
    with asammdf.MDF(version="4.10") as file:
        file.append(
            asammdf.Signal(rows, np.array([0.0, stamp, 0.2]), name="CAN_DataFrame", source=source)
        )  # fmt: skip
        file.save(tmp_path / "a.mf4")
    with pytest.raises(LogError, match=r"1 of 3 frames can't be read \(frame 2 .* is no time\)"):
        Recording(tmp_path / "a.mf4")
    assert Recording(tmp_path / "a.mf4", partial=True).count == 2


def test_several_channels_are_asked_for_with_their_frames(tmp_path: Path) -> None:
    text = f"{STAMP} can0 181#11\n{STAMP} can1 181#22\n{STAMP} can1 20000080#0000080000000000\n"
    with pytest.raises(
        LogError, match=r"several channels \(can0: 1 frames, can1: 2 frames\); name one with --channel"
    ):
        recording(tmp_path / "a.log", text)
    found = recording(tmp_path / "a.log", text, channel="can1")
    assert kinds_of(found.identifiers) == {"data": 1, "remote": 0, "error": 1}
    with pytest.raises(LogError, match="no frames of channel vcan0; there are can0: 1 frames"):
        recording(tmp_path / "a.log", text, channel="vcan0")
