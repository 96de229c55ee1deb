"""Fixed-size records of the rings for frames and events, between recorder and writer. Ticks need none."""

from __future__ import annotations

import struct
from typing import Final

FRAME_RECORD: Final = struct.Struct("<qIBB64s")
"""Same bytes as :data:`hil.log.schema.FRAME`."""
EVENT: Final = struct.Struct("<qQHH")
EVENT_BYTES: Final = 512
KIND_BYTES: Final = 64


def pack_event_record(t_ns: int, k: int, kind: str, text: str) -> bytes:
    """An event as a ring record; kind and text are cut to what it holds."""
    kind_raw = kind.encode(errors="replace")[:KIND_BYTES]
    text_raw = text.encode(errors="replace")[: EVENT_BYTES - EVENT.size - len(kind_raw)]
    record = EVENT.pack(t_ns, k, len(kind_raw), len(text_raw)) + kind_raw + text_raw
    return record.ljust(EVENT_BYTES, b"\0")
