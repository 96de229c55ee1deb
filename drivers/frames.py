"""What is seen on the bus, as bits of the tick's rx_flags, and what a command is made of."""

from __future__ import annotations

from typing import Final

# equal to hil's own by a test
FRESH: Final = 1 << 0
CRC_ERROR: Final = 1 << 1
COUNTER_REPEATED: Final = 1 << 2
COUNTER_JUMP: Final = 1 << 3
LENGTH_ERROR: Final = 1 << 4
STATUS: Final = 1 << 5
EMERGENCY: Final = 1 << 6
ERROR_FRAME: Final = 1 << 7
BUS_DOWN: Final = 1 << 8
FOREIGN_COMMAND: Final = 1 << 9
SEND_FAILED: Final = 1 << 10

SOURCES: Final = (
    "counter",
    "controlword",
    "u_q",
    "u_d",
    "load_torque",
    "enable",
    "reset",
    "load_enable",
)
"""Values of a command, in the order in which they are handed to the encoder."""
PLACES: Final = {name: place for place, name in enumerate(SOURCES)} | {
    "i_q_ref": SOURCES.index("u_q"),
    "i_d_ref": SOURCES.index("u_d"),
    "torque_ref": SOURCES.index("u_q"),
}
"""The place of each part of a command among its values: what the drive takes goes where a voltage would."""
SENT_FIELDS: Final = ("counter", "controlword", "u_q", "u_d", "T_L")
"""Fields of a tick that make its command."""
CONTROLWORD: Final = SOURCES.index("controlword")
ENABLE_OPERATION: Final = 0x0F
"""The one controlword with which a drive may operate."""
