"""Instructions a tick, phase by phase: runs in the bench machine, where an instruction is a nanosecond.

For each bus: three plain runs of `hil run`, two with the meter of `hil bench` around the phases, and the bare
loop against the same drive as the floor. A stall of the machine only adds, so the lowest counts. The thread's
processor time is read, so that waiting counts for nothing. Leaves $OUT/instructions.json.

For each shipped drive: three plain runs of its configuration, and the log of the one that counts.

For a CiA 402 node and for two the same, of `configs/dyno.toml` against
:mod:`tests.vm.guest.responder`. Leaves $OUT/nodes.json.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil import cli
from hil.bench.meter import run_metered
from hil.bench.pieces import guard_ns
from hil.config.tables import RunConfig, load_toml
from tests.vm.guest import responder
from tests.vm.guest.process import CONFIG, FD, KERNEL, SCRATCH, Forked

SECONDS = 0.5
RUNS = ("first", "second", "third")
ATTEMPTS = 3
"""A stall of the whole machine can end a run; a count is of a run that went to its end."""
BUSES: dict[str, tuple[str, str, tuple[str, ...], tuple[str, ...]]] = {
    # name: controller's interface, drive's interface, settings, settings of the plant
    "vcan": ("vcan0", "vcan0", (), ()),
    "kvaser": ("can0", "can1", (), ()),
    "kernel": ("vcan0", "vcan0", KERNEL, ()),
    "fd": ("vcan0", "vcan0", FD, ('dbc="../drives/hil_pmsm_fd.dbc"',)),
}
"""kernel: SYNC by the kernel's timer, for the loop and for the bare loop."""


DRIVES = ("current", "cia402", "moteus", "odrive")
"""configs/NAME.toml."""
NODES = {"node": (5,), "nodes": (5, 6)}
"""The motor of configs/dyno.toml, and both."""
NODES_SECONDS = 2.0
"""Longer, since both arm, start and stop in Python, which is no tick's cost, and two twice."""
CALM = ("load=[]", "truth=false")


def flags(name: str, *values: str) -> list[str]:
    """``name value`` for each value."""
    return [word for value in values for word in (name, value)]


def run_bare(interface: str, dbc: Path, ticks: int, priority: int, by_kernel: bool) -> float:
    """Instructions a tick of the bare loop."""
    from drivers.bare import bare_answers, bare_loop, exchange_of, open_raw
    from drivers.bcm import all_but, kernel_sync
    from drivers.codec import Database

    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    sockets, database, period_ns = open_raw("socketcan", interface), Database(dbc, 1), 1_000_000
    frames = exchange_of(database)
    if not by_kernel:
        return bare_loop(sockets, frames, period_ns, ticks).processor_us * 1e3
    can_id = database.message("SYNC").send_id
    all_but(sockets[0], can_id)
    return bare_answers(sockets, frames, kernel_sync(interface, can_id, True, period_ns), ticks) * 1e3


def result(name: str, job: Callable[[], int], out: Path) -> str:
    """What a process of its own printed, once it went to its end."""
    for _ in range(ATTEMPTS):
        if (code := Forked(out, job).wait()) == 0:
            return out.read_text()
        sys.stderr.write(f"{name}: {out.name} ended with {code}: {out.read_text()[:300]}\n")
    raise RuntimeError(f"{name}: {out.name} ended with {code}: {out.read_text()[:300]}")


def without(text: str, *tables: str) -> str:
    """A configuration without these tables."""
    parts = text.split("\n[")
    return "\n[".join(part for part in parts if not part.startswith(tables))


def nodes_config(folder: Path) -> Path:
    """`configs/dyno.toml` for nodes that are set up, with nothing that an emulator alone has."""
    text = without(
        Path("configs/dyno.toml").read_text(), "drive.canopen", "drive.emulator", "drive.signals.units"
    )
    lines = [line for line in text.splitlines() if not line.startswith("load_true")]
    path = folder / "nodes.toml"
    path.write_text("\n".join(lines).replace("drives/", f"{Path('configs/drives').resolve()}/"))
    return path


class Bus:
    """One bus of :data:`BUSES` with an emulated drive on it, or one with the drives of :data:`DRIVES`."""

    def __init__(self, name: str) -> None:
        self.name, self.config, calm = name, CONFIG, CALM
        if name in DRIVES:
            self.own, self.drive, self.settings, plant = "vcan0", "vcan0", (), ()
            self.config, calm = f"configs/{name}.toml", ()
        else:
            self.own, self.drive, self.settings, plant = BUSES[name]
        self.folder = SCRATCH / f"instructions-{name}"
        self.folder.mkdir()
        words = ("emulate", self.config, *self.words(self.drive), *flags("--plant-set", *calm, *plant))
        self.emulator = Forked.hil(self.folder / "emulator.txt", *words)

    def words(self, interface: str) -> list[str]:
        return ["-i", "socketcan", "-c", interface, *flags("--set", *self.settings)]

    def run_words(self) -> list[str]:
        arm = [] if self.own.startswith("vcan") else ["--arm", "--yes"]
        more = (f'log.folder="{self.folder}"', f"loop.duration_s={SECONDS}")
        return ["run", self.config, *self.words(self.own), "--json", *arm, *flags("--set", *more)]

    def result(self, job: Callable[[], int], name: str) -> str:
        """:func:`result` of a job of this bus."""
        return result(self.name, job, self.folder / name)

    def run(self, name: str) -> dict[str, Any]:
        """What a plain run says of itself."""
        said: dict[str, Any] = json.loads(self.result(lambda: cli.main(self.run_words()), name))
        return said

    def plain(self, name: str) -> float:
        return float(self.run(name)["processor_us"]) * 1e3

    def phases(self) -> dict[str, float]:
        report = self.folder / "phases.json"
        self.result(lambda: run_metered(report, self.run_words()), "metered")
        found: dict[str, float] = json.loads(report.read_text())
        return found

    def bare(self) -> float:
        config = load_toml(Path(CONFIG), RunConfig, list(self.settings))
        dbc, ticks = Path(CONFIG).parent / config.drive.dbc, round(SECONDS * 1000)

        def job() -> int:
            by_kernel = config.bus.sync == "kernel"
            sys.stdout.write(str(run_bare(self.own, dbc, ticks, config.realtime.fifo_priority, by_kernel)))
            return 0

        return float(self.result(job, "bare"))

    def measure(self) -> dict[str, Any]:
        self.emulator.until("ready")
        try:
            runs = [self.plain(name) for name in RUNS]
            phases = min((self.phases() for _ in range(2)), key=lambda found: sum(found.values()))
            return {"runs": sorted(runs), "phases": phases, "bare": self.bare()}
        finally:
            self.emulator.send_signal(signal.SIGTERM)
            self.emulator.wait()

    def measure_drive(self, out: Path) -> dict[str, Any]:
        """Of :data:`DRIVES`."""
        self.emulator.until("ready")
        try:
            if self.name == "cia402":  # it has forgotten its mapping while it was off
                words = ["configure", self.config, *self.words(self.own), "--json"]
                self.result(lambda: cli.main(words), "configured")
            said = [self.run(name) for name in RUNS]
            counted = min(said, key=lambda one: float(one["processor_us"]))
            shutil.copy(counted["log"], out / f"{self.name}.mcap")
            return {"runs": sorted(float(one["processor_us"]) * 1e3 for one in said), "said": counted}
        finally:
            self.emulator.send_signal(signal.SIGTERM)
            self.emulator.wait()


def count_nodes(out: Path) -> None:
    """:data:`NODES` to $OUT/nodes.json."""
    found = {name: measure_nodes(name, out) for name in NODES}
    (out / "nodes.json").write_text(json.dumps(found))


def measure_nodes(name: str, out: Path) -> dict[str, Any]:
    """One node or two of :data:`NODES`: three plain runs, and the log of the one that counts."""
    folder = SCRATCH / f"instructions-{name}"
    folder.mkdir()
    path, ids = nodes_config(folder), NODES[name]
    dbc = Path("configs/drives/cia402.dbc")
    peer = Forked(folder / "peer.txt", lambda: responder.serve("vcan0", dbc, *ids))
    peer.until("ready")
    chosen = ['node="motor"'] if len(ids) == 1 else []
    settings = (f'log.folder="{folder}"', f"loop.duration_s={NODES_SECONDS}", "feedback.hold_ticks=20",
                "drive.0.reference.w_rad_s=0.0")  # fmt: skip
    words = ["run", str(path), "-i", "socketcan", "-c", "vcan0", "--json"]
    words += flags("--set", *settings, *chosen)
    try:
        said = [json.loads(result(name, lambda: cli.main(words), folder / run)) for run in RUNS]
    finally:
        peer.send_signal(signal.SIGTERM)
        peer.wait()
    counted = min(said, key=lambda one: float(one["processor_us"]))
    shutil.copy(counted["log"], out / f"{name}.mcap")
    return {"runs": sorted(float(one["processor_us"]) * 1e3 for one in said), "said": counted}


def measure(out: Path) -> None:
    """Everything; a bus that the host has not is left out. What is done is there at once."""
    from hil.runtime.setup import Overrides, load_setup

    found: dict[str, Any] = {"guard": guard_ns(load_setup(Path(CONFIG), Overrides()).machine), "buses": {}}
    for name, (own, *_) in BUSES.items():
        if Path(f"/sys/class/net/{own}").exists():
            found["buses"][name] = Bus(name).measure()
            (out / "instructions.json").write_text(json.dumps(found))
    for name in DRIVES:
        found["buses"][name] = Bus(name).measure_drive(out)
        (out / "instructions.json").write_text(json.dumps(found))
