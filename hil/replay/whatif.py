"""`hil replay --config`: another observer, other gains over the measurements of a log, in open loop.

The new controller sees what was measured and what was really applied (logged ``ua_q``, ``ua_d``); what it
would have commanded is computed and compared, but the motor answered to the logged commands. So estimates
can be compared as they are, and commands only as first reactions: in closed loop all would have gone another
way. It runs as a shadow run does, by the same kernel.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.config.design import Machine, build
from hil.config.tables import RunConfig
from hil.control.law import FAC
from hil.errors import HilError
from hil.log.mcapfile import RunFile
from hil.log.origin import origin
from hil.log.reader import Log, LogError, Source, new_log
from hil.log.recorder import check_folder
from hil.log.split import STATE
from hil.replay import machine_of, refold, set_inputs, state_text, tick_blocks, wire_of_log
from hil.signals import FIELDS, DriveState, TickArray, new_ticks

COMPARED: Final = tuple(field.name for field in FIELDS if field.shown.what_if)
"""What is compared: the estimates, and what the law asks for before the guard."""
UNITS: Final = {f.name: f.unit for f in FIELDS}


@dataclass(slots=True)
class Spread:
    """Difference new - logged of one signal over the ticks in which both operate."""

    count: int = 0
    square: float = 0.0
    top: float = 0.0

    def add(self, difference: Any) -> None:
        """Take a block's differences; values that are not finite are left out."""
        finite = difference[np.isfinite(difference)]
        if len(finite):
            self.count += len(finite)
            self.square += float(np.sum(finite * finite))
            self.top = max(self.top, float(np.abs(finite).max()))

    @property
    def rms(self) -> float:
        """Root mean square, NaN for no ticks."""
        return float(np.sqrt(self.square / self.count)) if self.count else float("nan")


@dataclass(slots=True)
class WhatIf:
    """What another controller would have estimated and asked for."""

    log: Path
    config: Path
    ticks: int = 0
    written: Path | None = None
    spreads: dict[str, Spread] = field(default_factory=lambda: {name: Spread() for name in COMPARED})

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "log": str(self.log),
            "config": str(self.config),
            "open_loop": True,
            "ticks": self.ticks,
            "written": None if self.written is None else str(self.written),
            "rows": [
                {"signal": name, "unit": UNITS[name], "rms": s.rms, "max": s.top, "ticks": s.count}
                for name, s in self.spreads.items()
            ],
        }


def other_machine(log: Log, config: RunConfig) -> Machine:
    """The controller of ``config`` as a shadow beside the one that wrote the log. Raises HilError."""
    logged = json.loads(log.attachments["config.json"])
    rate = logged["loop"]["rate_hz"]
    if config.loop.rate_hz != rate:
        raise HilError(f"{log.path}: was logged at {rate:g} Hz; loop.rate_hz must be the same")
    shadow = config.model_copy(update={"loop": config.loop.model_copy(update={"shadow": True})})
    machine = build(shadow, wire_of_log(log))
    logged_law = machine_of(log).law
    if int(machine.law["pair"][0]) not in (0, int(logged_law["pair"][0])):
        raise HilError(
            f"{log.path}: controller.kind {config.controller.kind}: half of one law over two nodes, and this "
            "log is of no run under it: it does not say what each told the other"
        )
    if machine.law["k_th"][0] and not logged_law["k_th"][0]:
        raise HilError(
            f"{log.path}: controller.kind {config.controller.kind} follows an angle, and this log is of a "
            "law that has none for a reference"
        )
    if FAC in (int(machine.law["kind"][0]), int(logged_law["kind"][0])):
        raise HilError(f"{log.path}: controller.kind fac commands a load torque that no log says was applied")
    return machine.fresh()


def with_successor(blocks: Iterator[TickArray]) -> Iterator[tuple[TickArray, Any]]:
    """Each block with the tick that follows it, None for the last."""
    before: TickArray | None = None
    for ticks in blocks:
        if before is not None:
            yield before, ticks[0]
        before = ticks if len(ticks) else before
    if before is not None:
        yield before, None


def seen_inputs(logged: TickArray, successor: Any) -> TickArray:
    """The inputs of a shadow run: ``u_seen`` is what was applied from a tick on, logged with the next one."""
    ticks = new_ticks(len(logged))
    set_inputs(ticks, logged)
    for seen, applied in (("u_q_seen", "ua_q"), ("u_d_seen", "ua_d")):
        ticks[seen][:-1] = logged[applied][1:]
        ticks[seen][-1] = 0.0 if successor is None else successor[applied]
    return ticks


def compare_block(found: WhatIf, logged: TickArray, again: TickArray) -> None:
    """Gather the differences of the ticks in which both operate."""
    enabled = int(DriveState.OPERATION_ENABLED)
    both = (logged["state"] == enabled) & (again["state"] == enabled)
    for name, spread in found.spreads.items():
        spread.add(again[name][both] - logged[name][both])


def header(log: Log, config: Path, machine: Machine, used: RunConfig) -> dict[str, Any]:
    """The log's own header with the new controller in it."""
    shadow = used.model_copy(update={"loop": used.loop.model_copy(update={"shadow": True})})
    new = {
        "config.toml": config.read_text(encoding="utf-8"),
        "config.json": shadow.model_dump_json(),
        "controller.json": machine.to_json(),
    }
    if STATE in log.attachments:  # a part of a run: the new controller begins with it, whatever its number
        new[STATE] = state_text(machine, json.loads(log.attachments[STATE])["k"])
    run = log.metadata.get("run", {}) | origin() | {"kind": "what-if", "of": log.path.name}
    return {"metadata": run, "attachments": log.attachments | new}


def what_if(
    source: Source, config_path: Path, config: RunConfig, out: Path | None = None, node: str = ""
) -> WhatIf:
    """Run the controller of ``config`` over a log, of several nodes one's; ``out`` gets its ticks.

    Raises HilError.
    """
    log = new_log(source, node)
    if out is not None:
        if out.exists():
            raise HilError(f"{out}: exists already; name another file with -o")
        check_folder(out.resolve(), sum(path.stat().st_size for path in log.parts or (log.path,)))
    found = WhatIf(log.path, config_path, written=out)
    machine: Machine | None = None
    file: RunFile | None = None
    try:
        for logged, successor in with_successor(tick_blocks(log)):
            if machine is None:
                machine = other_machine(log, config)
                file = RunFile(out, header(log, config_path, machine, config)) if out else None
            again = refold(machine, seen_inputs(logged, successor))
            compare_block(found, logged, again)
            found.ticks += len(logged)
            if file:
                file.add_ticks(again)
    finally:
        if file:
            file.finish({"ended": "what-if", "ticks": found.ticks, "skipped": 0})
    if machine is None:
        raise LogError(f"{log.path}: {log.damage or 'the log has no ticks'}")
    return found
