"""Words for the error codes of drives: CiA 402-2's own, and CiA 301's classes for all others.

A drive's emergency message and its object 603Fh carry one; no EDS has words for them.
"""

from __future__ import annotations

from typing import Final

CODES: Final = {
    0x2110: "short circuit or earth leakage at the input", 0x2120: "earth leakage at the input",
    0x2130: "short circuit at the input", 0x2211: "internal current 1", 0x2212: "internal current 2",
    0x2213: "over-current in the ramp", 0x2214: "over-current in the sequence",
    0x2220: "continuous over-current inside", 0x2230: "short circuit or earth leakage inside",
    0x2240: "earth leakage inside", 0x2250: "short circuit inside", 0x2310: "continuous over-current",
    0x2311: "over-current 1", 0x2312: "over-current 2", 0x2320: "short circuit or earth leakage at the motor",
    0x2330: "earth leakage at the motor", 0x2331: "earth leakage, phase U",
    0x2332: "earth leakage, phase V", 0x2333: "earth leakage, phase W", 0x2340: "short circuit at the motor",
    0x2350: "load level, thermal state (i2t)", 0x2351: "load level, thermal warning",
    0x3110: "mains over-voltage", 0x3120: "mains under-voltage", 0x3130: "mains phase failure",
    0x3210: "DC link over-voltage", 0x3211: "over-voltage 1", 0x3212: "over-voltage 2",
    0x3220: "DC link under-voltage", 0x3221: "under-voltage 1", 0x3222: "under-voltage 2",
    0x3230: "load error", 0x3310: "output over-voltage", 0x3320: "armature circuit", 0x3330: "field circuit",
    0x4110: "excess ambient temperature", 0x4120: "too low ambient temperature",
    0x4210: "excess temperature of the drive", 0x4220: "too low temperature of the drive",
    0x4310: "excess temperature of the drive", 0x4410: "excess temperature of the supply",
    0x5110: "low voltage supply", 0x5112: "supply +24 V", 0x5113: "supply +5 V", 0x5114: "supply +15 V",
    0x5210: "measurement circuit", 0x5220: "computing circuit", 0x5300: "operating unit",
    0x5400: "power section", 0x5441: "contactor 1", 0x5510: "RAM", 0x5520: "ROM", 0x5530: "EEPROM",
    0x6010: "software reset (watchdog)", 0x6100: "internal software", 0x6310: "loss of parameters",
    0x6320: "parameter error", 0x7110: "brake chopper", 0x7111: "failure of the brake chopper",
    0x7112: "over-current of the brake chopper", 0x7113: "protective circuit of the brake chopper",
    0x7120: "motor", 0x7121: "motor blocked", 0x7122: "motor error or commutation",
    0x7123: "motor tilted", 0x7300: "sensor", 0x7301: "tacho", 0x7302: "tacho, wrong polarity",
    0x7303: "resolver 1", 0x7304: "resolver 2", 0x7305: "incremental encoder 1",
    0x7306: "incremental encoder 2", 0x7310: "speed", 0x7320: "position", 0x7500: "communication",
    0x8100: "communication", 0x8110: "CAN overrun, frames lost", 0x8120: "CAN error passive",
    0x8130: "life guard or heartbeat lost", 0x8140: "recovered from bus-off", 0x8150: "identifier collision",
    0x8210: "PDO too short", 0x8220: "PDO too long", 0x8240: "SYNC of another length",
    0x8250: "no RPDO in time", 0x8300: "torque control",
    0x8311: "excess torque", 0x8312: "difficult start-up", 0x8331: "torque fault", 0x8400: "speed controller",
    0x8500: "position controller", 0x8600: "positioning controller", 0x8611: "following error",
    0x8612: "reference limit", 0x8700: "sync controller", 0x8800: "winding controller",
    0x9000: "external error", 0xF001: "deceleration", 0xF002: "sub-synchronous run", 0xF003: "stroke",
    0xF004: "control",
}  # fmt: skip
CLASSES: Final = {
    0x10: "generic error", 0x20: "current", 0x21: "current at the input", 0x22: "current inside",
    0x23: "current at the output", 0x30: "voltage", 0x31: "mains voltage", 0x32: "voltage inside",
    0x33: "output voltage", 0x40: "temperature", 0x41: "ambient temperature", 0x42: "device temperature",
    0x50: "hardware", 0x60: "software", 0x61: "internal software", 0x62: "user software", 0x63: "data set",
    0x70: "additional modules", 0x80: "monitoring", 0x81: "communication", 0x82: "protocol",
    0x90: "external error", 0xF0: "additional functions", 0xFF: "of the maker",
}  # fmt: skip
"""By the code's upper byte, CiA 301."""


def words(code: int) -> str:
    """What a code means, as "0x2310, continuous over-current"; the number alone where nobody says."""
    text = CODES.get(code) or CLASSES.get(code >> 8) or CLASSES.get(code >> 8 & 0xF0, "")
    return f"0x{code:04X}" + (f", {text}" if text else "")
