"""AUTOSAR end-to-end protection, profiles 2 and 5: CRC and counter of a frame.

Profile 2: byte 0 CRC-8 (polynomial 0x2F, start 0xFF, inverted) over bytes 1.. and the data id of the
counter; byte 1 low nibble counter. Profile 5: bytes 0-1 CRC-16 (0x1021, start 0xFFFF) over bytes 2.. and the
16-bit data id, low byte first; byte 2 counter. Source: AUTOSAR Specification of SW-C End-to-End
Communication Protection Library.
"""

from __future__ import annotations

from binascii import crc_hqx


def _crc8_table(polynomial: int) -> bytes:
    table = bytearray()
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ polynomial) & 0xFF if value & 0x80 else value << 1
        table.append(value)
    return bytes(table)


CRC8_TABLE = _crc8_table(0x2F)


def crc_profile_2(data: bytes, data_ids: bytes) -> int:
    """CRC-8 of a frame whose counter (byte 1, low nibble) picks one of 16 data ids."""
    crc = 0xFF
    for byte in data[1:]:
        crc = CRC8_TABLE[crc ^ byte]
    return CRC8_TABLE[crc ^ data_ids[data[1] & 0x0F]] ^ 0xFF


def crc_profile_5(data: bytes, data_id: int) -> int:
    """CRC-16 of a frame, over bytes 2.. and the data id."""
    return crc_hqx(bytes((data_id & 0xFF, data_id >> 8)), crc_hqx(data[2:], 0xFFFF))


def crc_of(profile: int, data: bytes, data_ids: bytes) -> bytes:
    """The first bytes of a frame of profile 2 or 5; ``data_ids`` as the DBC's attribute has them."""
    if profile == 2:
        return bytes((crc_profile_2(data, data_ids),))
    return crc_profile_5(data, int.from_bytes(data_ids, "big")).to_bytes(2, "little")
