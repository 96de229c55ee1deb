"""The real loop against the emulated drive over the bus, in lockstep, and its log replayed to the bit.

python examples/lockstep_and_replay.py [FOLDER]
"""

import sys
from pathlib import Path

import hil

CONFIG = Path(__file__).parents[1] / "configs" / "demo.toml"
OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "logs").resolve()

OUT.mkdir(exist_ok=True)
setup = hil.load(CONFIG, {"loop.clock": "lockstep", "loop.duration_s": 1.5, "log.folder": str(OUT)})
log = hil.run(setup, emulated=True)
verdict = hil.replay(log)
print(f"{len(log.ticks)} ticks in {log.path.name}, ended: {log.result['ended']}")
print(f"replay: {verdict.verdict}, {verdict.ticks} ticks")
print(f"report passed: {hil.report(log.path, path=OUT / 'lockstep.html').passed}")
