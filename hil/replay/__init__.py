"""`hil replay`: re-run the controller over a log and compare every output by bits.

A pure fold: same inputs, same parameters, same code. Exit codes: 0 same, 1 differs, 2 cannot.
"""

from __future__ import annotations

from hil.replay.fold import bits, compare, fold, refold, replayed, set_inputs
from hil.replay.machine import machine_of, restored, state_text, wire_of_log
from hil.replay.run import Replay, Window, replay, replay_log, tick_blocks
from hil.replay.verdict import Difference, Verdict

__all__ = [
    "Difference",
    "Replay",
    "Verdict",
    "Window",
    "bits",
    "compare",
    "fold",
    "machine_of",
    "refold",
    "replay",
    "replay_log",
    "replayed",
    "restored",
    "set_inputs",
    "state_text",
    "tick_blocks",
    "wire_of_log",
]
