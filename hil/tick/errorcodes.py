"""Words for the error codes of drives: CiA 402-2's own, and CiA 301's classes for all others.

A drive's emergency message and its object 603Fh carry one. An EDS or DCF has no words for them: CiA 306 has
no key for what a value means, and the names of 1003h, 1014h and 603Fh are the objects' own ("Error code").
"""

from __future__ import annotations

from typing import Final

CODES: Final = {
    0x2110: "short circuit or earth leakage at the input", 0x2120: "earth leakage at the input",
    0x2121: "earth leakage, phase L1", 0x2122: "earth leakage, phase L2", 0x2123: "earth leakage, phase L3",
    0x2130: "short circuit at the input", 0x2131: "short circuit, L1 to L2",
    0x2132: "short circuit, L2 to L3", 0x2133: "short circuit, L3 to L1", 0x2211: "internal current 1",
    0x2212: "internal current 2", 0x2213: "over-current in the ramp", 0x2214: "over-current in the sequence",
    0x2220: "continuous over-current inside", 0x2221: "continuous over-current inside 1",
    0x2222: "continuous over-current inside 2", 0x2230: "short circuit or earth leakage inside",
    0x2240: "earth leakage inside", 0x2250: "short circuit inside", 0x2310: "continuous over-current",
    0x2311: "continuous over-current 1", 0x2312: "continuous over-current 2",
    0x2320: "short circuit or earth leakage at the motor",
    0x2330: "earth leakage at the motor", 0x2331: "earth leakage, phase U",
    0x2332: "earth leakage, phase V", 0x2333: "earth leakage, phase W", 0x2340: "short circuit at the motor",
    0x2341: "short circuit, U to V", 0x2342: "short circuit, V to W", 0x2343: "short circuit, W to U",
    0x2350: "load level, thermal state (i2t)", 0x2351: "load level, thermal warning",
    0x3110: "mains over-voltage", 0x3111: "mains over-voltage, L1", 0x3112: "mains over-voltage, L2",
    0x3113: "mains over-voltage, L3", 0x3120: "mains under-voltage", 0x3121: "mains under-voltage, L1",
    0x3122: "mains under-voltage, L2", 0x3123: "mains under-voltage, L3", 0x3130: "mains phase failure",
    0x3131: "mains phase failure, L1", 0x3132: "mains phase failure, L2", 0x3133: "mains phase failure, L3",
    0x3134: "mains phase sequence", 0x3140: "mains frequency", 0x3141: "mains frequency too high",
    0x3142: "mains frequency too low", 0x3210: "DC link over-voltage", 0x3211: "over-voltage 1",
    0x3212: "over-voltage 2", 0x3220: "DC link under-voltage", 0x3221: "under-voltage 1",
    0x3222: "under-voltage 2", 0x3230: "load error", 0x3310: "output over-voltage",
    0x3311: "output over-voltage, U", 0x3312: "output over-voltage, V", 0x3313: "output over-voltage, W",
    0x3320: "armature circuit", 0x3321: "armature circuit open", 0x3330: "field circuit",
    0x3331: "field circuit open",
    0x4110: "excess ambient temperature", 0x4120: "too low ambient temperature",
    0x4130: "temperature of the supply air", 0x4140: "temperature of the outlet air",
    0x4210: "excess temperature of the device", 0x4220: "too low temperature of the device",
    0x4310: "excess temperature of the drive", 0x4320: "too low temperature of the drive",
    0x4410: "excess temperature of the supply", 0x4420: "too low temperature of the supply",
    0x5110: "low voltage supply", 0x5111: "supply +/-15 V", 0x5112: "supply +24 V", 0x5113: "supply +5 V",
    **{0x5110 + n: f"supply U{n}, of the maker" for n in range(4, 10)},
    0x5120: "supply of the intermediate circuit", 0x5200: "control", 0x5210: "measurement circuit",
    0x5220: "computing circuit", 0x5300: "operating unit", 0x5400: "power section", 0x5410: "output stages",
    0x5420: "chopper", 0x5430: "input stages", 0x5440: "contacts",
    **{0x5440 + n: f"contact {n}" for n in range(1, 6)},
    0x5450: "fuses", **{0x5450 + n: f"fuse {n}" for n in range(1, 10)},
    0x5500: "memory", 0x5510: "RAM", 0x5520: "ROM", 0x5530: "EEPROM",
    0x6010: "software reset (watchdog)", **{0x6300 + n: f"data record {n}" for n in range(1, 16)},
    0x6310: "loss of parameters", 0x6320: "parameter error",
    0x7100: "power", 0x7110: "brake chopper", 0x7111: "failure of the brake chopper",
    0x7112: "over-current of the brake chopper", 0x7113: "protective circuit of the brake chopper",
    0x7120: "motor", 0x7121: "motor blocked", 0x7122: "motor error or commutation",
    0x7123: "motor tilted", 0x7200: "measurement circuit", 0x7300: "sensor", 0x7301: "tacho",
    0x7302: "tacho, wrong polarity", 0x7303: "resolver 1", 0x7304: "resolver 2",
    0x7305: "incremental encoder 1", 0x7306: "incremental encoder 2", 0x7307: "incremental encoder 3",
    0x7310: "speed", 0x7320: "position", 0x7400: "computing circuit", 0x7500: "communication",
    0x7510: "serial interface 1", 0x7520: "serial interface 2", 0x7600: "data storage",
    0x8100: "communication", 0x8110: "CAN overrun, frames lost", 0x8120: "CAN error passive",
    0x8130: "life guard or heartbeat lost", 0x8140: "recovered from bus-off", 0x8150: "identifier collision",
    0x8210: "PDO too short", 0x8220: "PDO too long", 0x8230: "MPDO to an object that is not there",
    0x8240: "SYNC of another length", 0x8250: "no RPDO in time", 0x8300: "torque control",
    0x8311: "excess torque", 0x8312: "difficult start-up", 0x8313: "standstill torque",
    0x8321: "insufficient torque", 0x8331: "torque fault", 0x8400: "speed controller",
    0x8500: "position controller", 0x8600: "positioning controller", 0x8611: "following error",
    0x8612: "reference limit", 0x8613: "homing", 0x8700: "sync controller", 0x8800: "winding controller",
    0x8900: "process data", 0x8A00: "control",
    0x9000: "external error", 0xF001: "deceleration", 0xF002: "sub-synchronous run", 0xF003: "stroke",
    0xF004: "control",
}  # fmt: skip
CLASSES: Final = {
    0x10: "generic error", 0x20: "current", 0x21: "current at the input", 0x22: "current inside",
    0x23: "current at the output", 0x30: "voltage", 0x31: "mains voltage", 0x32: "voltage inside",
    0x33: "output voltage", 0x40: "temperature", 0x41: "ambient temperature", 0x42: "device temperature",
    0x43: "drive temperature", 0x44: "supply temperature", 0x50: "hardware", 0x60: "software",
    0x61: "internal software", 0x62: "user software", 0x63: "data set",
    0x70: "additional modules", 0x80: "monitoring", 0x81: "communication", 0x82: "protocol",
    0x90: "external error", 0xF0: "additional functions", 0xFF: "of the maker",
}  # fmt: skip
"""By the code's upper byte, CiA 301; 43h and 44h are CiA 402's."""


def words(code: int) -> str:
    """What a code means, as "0x2310, continuous over-current"; the number alone where nobody says."""
    text = CODES.get(code) or CLASSES.get(code >> 8) or CLASSES.get(code >> 8 & 0xF0, "")
    return f"0x{code:04X}" + (f", {text}" if text else "")
