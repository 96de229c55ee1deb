"""Peer: one tick record a tick into mcap's own writer, in the loop itself. Prints one JSON line.

The same record at 1 kHz, with chunks of the size that `hil run` uses; ``stall_us`` is the worst call, when
mcap compresses and writes a chunk.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hil.log.mcapfile import CHUNK_BYTES
from hil.signals import new_ticks

TICKS = 4000
PERIOD_S = 1e-3


def costs_us(path: Path) -> list[float]:
    """What each record cost the caller [us]."""
    from mcap.writer import CompressionType, Writer

    rng, ticks, out = np.random.default_rng(5), new_ticks(), []
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("tick", "raw", b"")
        channel = writer.register_channel("/tick", "raw", schema)
        for k in range(TICKS):
            for name in ("w", "i_q", "i_d", "u_q", "u_d", "d_hat_w"):
                ticks[name] = rng.normal()
            begin = time.perf_counter_ns()
            writer.add_message(channel, k * 1_000_000, ticks.tobytes(), k * 1_000_000, k)
            out.append((time.perf_counter_ns() - begin) * 1e-3)
            time.sleep(PERIOD_S)
        writer.finish()
    return out


def main() -> None:
    """Write the records; print median and worst."""
    with tempfile.TemporaryDirectory() as folder:
        costs = costs_us(Path(folder) / "inline.mcap")
    median = float(np.median(costs))
    sys.stdout.write(json.dumps({"record_us": median, "stall_us": max(costs)}) + "\n")


if __name__ == "__main__":
    main()
