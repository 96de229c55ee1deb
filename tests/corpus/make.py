"""Makes the corpus out of ``base.log``: ``python -m tests.corpus.make``. Needs can-utils 2020.11, too.

``base.log`` is the beginning of a demo run with one of each odd frame put in. What a dialect can't hold is
taken out, or stands in the table as lost; times are kept where the tool keeps them. What is made is
kept in the repository: python-can's MF4 and asc2log's log hold the time at which they were made.
"""

from __future__ import annotations

import gzip
import re
import subprocess
from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path
from typing import Any

import can
import numpy as np

from tests import blf

HERE = Path(__file__).parent
ZONE = {"TZ": "UTC", "LC_ALL": "C", "PATH": "/usr/bin:/bin"}


def lines_of(name: str) -> list[str]:
    return (HERE / name).read_text().splitlines()


def put(name: str, lines: Iterable[str]) -> None:
    (HERE / name).write_text("".join(f"{line}\n" for line in lines))


def candump() -> None:
    """What candump's flags change in its log, by its source: -x adds the direction, -8 the raw DLC."""
    base = lines_of("base.log")
    bare = [line.rsplit(" ", 1)[0] for line in base]
    put("candump-l.log", bare)
    put("candump-L-x.log", base)
    put("candump-L-8.log", [re.sub(r"( 7A0#[0-9A-F]{16})$", r"\1_C", line) for line in bare])
    put("candump-no-errors.log", [line for line in bare if not re.search(r" 2000\w{4}#", line)])
    put("candump-any.log", [new for line in base for new in (line, line.replace(" can0 ", " vcan1 "))])
    put("candump-dots.log", [re.sub(r"(?<=#)([0-9A-F]{2})([0-9A-F]{2}) ", r"\1.\2 ", line) for line in base])
    (HERE / "candump.log.gz").write_bytes(gzip.compress((HERE / "base.log").read_bytes(), mtime=0))


def can_utils() -> None:
    """log2asc and asc2log, as they write."""
    for name, flags in (("log2asc.asc", ()), ("log2asc-f.asc", ("-f",)), ("log2asc-r.asc", ("-r",))):
        text = subprocess.run(
            ["log2asc", *flags, "-I", HERE / "base.log", "can0"], capture_output=True, env=ZONE, check=True
        ).stdout
        (HERE / name).write_bytes(text)
    text = subprocess.run(
        ["asc2log", "-I", HERE / "log2asc.asc"], capture_output=True, env=ZONE, check=False
    ).stdout
    (HERE / "asc2log.log").write_bytes(text)


def vector() -> None:
    """The dialects of Vector's tools, by hand out of log2asc's."""
    plain = [line for line in lines_of("log2asc.asc") if "ErrorFrame" not in line]
    put("vector-txrq.asc", (new for line in plain for new in _requested(line)))
    relative, before = [], Decimal(0)
    for line in plain:
        stamp, _, rest = line.strip().partition(" ")
        if re.fullmatch(r"\d+\.\d+", stamp):
            relative.append(f"   {Decimal(stamp) - before} {rest}")
            before = Decimal(stamp)
        else:
            relative.append(line.replace("absolute", "relative"))
    put("vector-relative.asc", relative)
    (HERE / "vector.asc.gz").write_bytes(gzip.compress((HERE / "log2asc.asc").read_bytes(), mtime=0))


def _requested(line: str) -> list[str]:
    return [re.sub(r"Tx  ", "TxRq", line), line] if " Tx  " in line else [line]


def messages() -> list[can.Message]:
    """The base as python-can's messages, not by its reader."""
    found = []
    for line in lines_of("base.log"):
        stamp, _, body, way = line.split()
        number, _, data = body.partition("#")
        error = len(number) == 8 and int(number, 16) & 0x20000000 != 0
        fd, remote = data.startswith("#"), data.startswith("R")
        raw = b"" if remote else bytes.fromhex(data[2:] if fd else data)
        found.append(
            can.Message(
                timestamp=float(stamp[1:-1]), arbitration_id=int(number, 16) & 0x1FFFFFFF,
                is_error_frame=error, is_remote_frame=remote, is_fd=fd, bitrate_switch=fd,
                is_extended_id=len(number) == 8 and not error, is_rx=way == "R", channel=0,
                data=raw, dlc=int(data[1:] or 0) if remote else len(raw),
            )
        )  # fmt: skip
    return found


def python_can() -> None:
    for ending in ("log", "asc", "blf", "mf4", "trc", "csv"):
        path = HERE / f"python-can.{ending}"
        with can.Logger(str(path)) as writer:
            for message in messages():
                writer(message)
    every = messages()
    with can.Logger(str(HERE / "out-of-order.blf")) as writer:
        for message in [*every[:1], *every[50:60], *every[1:50], *every[60:]]:
            writer(message)


def vector_blf() -> None:
    """The objects of Vector's own loggers, by hand: errors of three kinds, requests before what was sent."""
    start = round(messages()[0].timestamp * 1e6) // 1000 * 1_000_000
    errors = iter([(2, blf.error()), (73, blf.error_ext(0x204, b"", 1)), (104, blf.fd_error(0x204, b"\1"))])
    objects = []
    for at, message in enumerate(messages()):
        t_ns = round(message.timestamp * 1e6) * 1000 - start
        number = message.arbitration_id | (blf.EXTENDED if message.is_extended_id else 0)
        way, data = blf.RECEIVED if message.is_rx else blf.SENT, bytes(message.data)
        if message.is_error_frame:
            kind, body = next(errors)
            objects.append(blf.of(kind, t_ns, body))
        elif message.is_fd:
            objects.append(blf.of(101, t_ns, blf.fd_64(number, data, way=way)))
        else:
            if way == blf.SENT:
                objects.append(blf.of(1, t_ns - 1000, blf.message(number, data, way=blf.REQUESTED)))
            body = blf.message(number, data, way=way, remote=message.is_remote_frame, dlc=message.dlc)
            objects.append(blf.of(86, t_ns, body + bytes(8)) if at % 2 else blf.of(1, t_ns, body, version=2))
    whole = b"".join([*objects[:1], blf.of(4, 0, bytes(40)), *objects[1:]])
    parts = [blf.container(whole[at : at + 4000]) for at in range(0, len(whole), 4000)]
    (HERE / "vector.blf").write_bytes(blf.file_of(*parts))


def asammdf_without_ide() -> None:
    """The members that ASAM's bus logging demands, and no others."""
    import asammdf

    own = [m for m in messages() if not (m.is_error_frame or m.is_remote_frame or m.is_fd)]
    short = [("ID", "<u4"), ("DataLength", "u1"), ("DataBytes", "u1", (8,))]
    rows = np.zeros(len(own), np.dtype([(f"CAN_DataFrame.{name}", *rest) for name, *rest in short]))
    for row, message in zip(rows, own, strict=True):
        row["CAN_DataFrame.ID"] = message.arbitration_id | (0x80000000 if message.is_extended_id else 0)
        row["CAN_DataFrame.DataLength"] = len(message.data)
        row["CAN_DataFrame.DataBytes"][: len(message.data)] = list(message.data)
    source: Any = asammdf.blocks.v4_blocks.SourceInformation(source_type=2, bus_type=2)
    with asammdf.MDF(version="4.10") as file:
        times = np.array([m.timestamp for m in own])
        file.start_time = file.header.start_time = can_time(times[0])
        file.append(asammdf.Signal(rows, times - times[0], name="CAN_DataFrame", source=source))
        file.save(HERE / "asammdf-no-ide.mf4", overwrite=True)


def can_time(seconds: float) -> Any:
    from datetime import UTC, datetime

    return datetime.fromtimestamp(seconds, UTC)


def peak() -> None:
    """PEAK's trace 1.1 by hand, errors included."""
    rows, start = [], Decimal(lines_of("base.log")[0].split()[0][1:-1])
    days = (start / 86400 + 25569).quantize(Decimal("1.0000000000"))
    for number, line in enumerate(lines_of("base.log"), start=1):
        stamp, _, body, way = line.split()
        name, _, data = body.partition("#")
        at = f"{number:>6}) {(Decimal(stamp[1:-1]) - start) * 1000:>12.3f}  "
        spaced = " ".join(re.findall("..", data))
        if name.startswith("2000"):
            rows.append(f"{at}Error  0008  4  00 19 08 08 ")
        elif data.startswith("R"):
            rows.append(f"{at}Rx     {name:0>4}  {data[1:] or 0}  RTR")
        elif not data.startswith("#"):
            rows.append(f"{at}{'Rx' if way == 'R' else 'Tx'}     {name:0>4}  {len(data) // 2}  {spaced} ")
    put("peak-1.1.trc", [";$FILEVERSION=1.1", f";$STARTTIME={days}", ";", *rows])


if __name__ == "__main__":
    for make in (candump, can_utils, vector, vector_blf, python_can, asammdf_without_ide, peak):
        make()
