"""`hil configure`: a CiA 402 drive set up by SDO from its EDS, read back and compared, and its DBC.

Nothing here starts a node, enables a drive, or sends a SYNC or a command.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers import canopen_node as node
from drivers.bus import BusSettings, Link, open_link
from drivers.cia402 import COB_IDS, RPDO, STORE, Plan, Wish, plan_of
from drivers.cia402_dbc import dbc_of, differences
from drivers.eds import Dictionary, Place, place_of
from drivers.errors import DatabaseError, DriverError, NodeError
from drivers.scales import Said, Scales
from drivers.sdo import REQUEST, Sdo
from hil.config.drive import CanopenTable
from hil.config.tables import RunConfig
from hil.errors import ConfigError, HilError
from hil.log.outputs import output_file
from hil.runtime.claim import claimed

LISTEN_S = 0.05
TORQUE, MOST_TORQUE = 0x6071, 0x6072


@dataclass(slots=True)
class Result:
    """What a node was found to be, and is now; ``problems``: what is not as the config wants it."""

    node_id: int
    eds: str
    mode: str
    identity: dict[str, int]
    units: dict[str, str]
    options: list[node.Option]
    objects: list[node.Held]
    problems: list[str]
    text: str = ""
    dbc: Path | None = None
    written: bool = False
    stored: bool = False
    fault: int | None = None
    """Error code of a drive that stands in fault."""

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        objects = [
            {
                "object": str(held.entry.place),
                "what": held.entry.what,
                "wanted": held.wanted,
                "found": held.found,
                "ok": held.ok,
            }
            for held in self.objects
        ]
        return {
            "node": self.node_id,
            "eds": self.eds,
            "mode": self.mode,
            "identity": self.identity,
            "units": self.units,
            "options": {
                o.what: {"object": str(o.place), "code": o.code, "text": o.text} for o in self.options
            },
            "objects": objects,
            "written": self.written,
            "stored": self.stored,
            "dbc": str(self.dbc) if self.dbc else None,
            "fault": self.fault,
            "problems": self.problems,
            "ok": not self.problems,
        }


@dataclass(frozen=True, slots=True)
class Job:
    """A node's plan, made before anything is sent."""

    config: RunConfig
    table: CanopenTable
    base: Path
    eds: Dictionary
    plan: Plan
    bus: BusSettings

    @property
    def node_id(self) -> int:
        """The node."""
        return self.config.drive.node_id

    @property
    def where(self) -> str:
        """The bus in messages."""
        return f"{self.bus.interface}:{self.bus.channel}"

    def sdo(self, link: Link) -> Sdo:
        """A way to its objects."""
        return Sdo(link, self.node_id, self.where, self.table.answer_timeout_s)


def job_of(path: Path, config: RunConfig, bus: BusSettings) -> Job:
    """The plan of a config's node. Raises ConfigError or DatabaseError; opens no bus."""
    table = config.canopen
    if table is None:
        raise ConfigError(str(path), ['canopen: missing; add [canopen] with eds = "drives/NAME.eds"'])
    if not 1 <= config.drive.node_id <= 127:
        raise ConfigError(str(path), [f"drive.node_id = {config.drive.node_id}: CANopen has nodes 1 to 127"])
    eds = Dictionary(path.parent / table.eds, config.drive.node_id)
    wish = Wish(
        mode=table.mode,
        period_ns=config.loop.period_ns,
        heartbeat_ms=table.heartbeat_ms,
        rpdo=_places(table.rpdo),
        tpdo=_places(table.tpdo),
        sync_period=table.sync_period,
        rpdo_timeout_ms=table.rpdo_timeout_ms,
        every=config.feedback_every,
    )
    return Job(config, table, path.parent, eds, plan_of(eds, config.drive.node_id, wish), bus)


def _places(rows: list[list[str]] | None) -> tuple[tuple[Place, ...], ...]:
    """The objects of each PDO; the config's types let nothing pass that names none."""
    return tuple(tuple(filter(None, map(place_of, row))) for row in rows or ())


def configure(job: Job, *, store: bool, dbc: Path | None) -> Result:
    """Set the node and read all back. Raises HilError or DriverError; then nothing is enabled either."""
    if store and not job.eds.has(STORE, 1):
        raise DatabaseError(f"{job.eds.path}: has no object 1010h:1 (store parameters); leave --store out")
    if dbc is not None:
        output_file(dbc, ".dbc")
    sent = [job.node_id + base for base in COB_IDS[RPDO]]
    with _asked(job, *sent) as (link, sdo):
        _refuse_others(job, link)
        _known(job, sdo)
        node.refuse_running(sdo)
        node.refuse_mode(sdo, job.table.mode)
        scales = _scales(job, sdo)
        node.pre_operational(link, job.node_id)
        node.write(sdo, job.plan)
        node.confirm_mode(sdo, job.table.mode)
        result = _result(job, sdo, scales)
        _refuse_unkept(job, result)
        result.written = True
        if store:
            node.store(sdo)
            result.stored = True
    if dbc is not None:
        dbc.write_text(result.text, encoding="utf-8")
        result.dbc = dbc
    else:
        result.problems += dbc_problems(job, result)
    return result


def compare(job: Job) -> Result:
    """Only compare: what is not as it is wanted stands in ``problems``. Raises as :func:`configure`."""
    with _asked(job) as (_, sdo):
        return compared(job, sdo)


def compared(job: Job, sdo: Sdo) -> Result:
    """:func:`compare` where the bus is open and nobody else is asked for."""
    _known(job, sdo)
    result = _result(job, sdo, _scales(job, sdo))
    result.problems += [held.words() for held in result.objects if not held.ok]
    try:
        node.confirm_mode(sdo, job.table.mode)
    except NodeError as error:
        result.problems.append(str(error))
    result.problems += dbc_problems(job, result)
    return result


def looked_at(path: Path, config: RunConfig, bus: BusSettings, wait_s: float) -> Result:
    """:func:`compared` before a run: what a node no longer holds, and its fault. Raises as it does."""
    job = job_of(path, config, bus)
    link = open_link(bus)
    try:
        node.await_node(link, job.node_id, wait_s)
        return compared(job, job.sdo(link))
    finally:
        link.close()


@contextlib.contextmanager
def _asked(job: Job, *sent: int) -> Iterator[tuple[Link, Sdo]]:
    """The bus, with nobody else on this machine who asks this node by SDO or sends ``sent``."""
    names = [f"0x{number:X}" for number in (REQUEST + job.node_id, *sent)]
    with claimed(job.bus.interface, job.bus.channel, names):
        link = open_link(job.bus)
        try:
            yield link, job.sdo(link)
        finally:
            link.close()


def _refuse_others(job: Job, link: Link) -> None:
    heard = node.other_controller(link, job.node_id, LISTEN_S)
    if heard is not None:
        raise HilError(
            f"another controller sends 0x{heard:X} on {job.where}: nothing was changed; stop it first"
        )


def _known(job: Job, sdo: Sdo) -> None:
    """One node of this number, of the device that the EDS is of, that takes our SYNC."""
    sdo.alone()
    node.refuse_other_device(sdo, job.eds)
    node.refuse_other_sync(sdo)


def _scales(job: Job, sdo: Sdo) -> Scales:
    """Every unit, asked before anything is changed."""
    scales = Scales(
        sdo, Said(job.table.velocity_unit, job.table.rated_current or "", job.table.position_unit)
    )
    for pdo in job.plan.pdos:
        for one in pdo.objects:
            scales.of(one.place.index)
    return scales


def _result(job: Job, sdo: Sdo, scales: Scales) -> Result:
    identity = node.identity(sdo)
    what = f"Node with product 0x{identity.get('product', 0):X}"
    period_ms = job.config.loop.period_ns * 1e-6
    text = dbc_of(job.plan, job.node_id, scales, period_ms, job.table.heartbeat_ms, what)
    objects = list(node.compare(sdo, job.plan))
    limits = limit_problems(job, sdo, scales)
    told, options = scales.told, node.options(sdo)
    eds, mode, fault = str(job.eds.path), job.table.mode, node.fault_of(sdo)
    return Result(job.node_id, eds, mode, identity, told, options, objects, limits, text, fault=fault)


def _refuse_unkept(job: Job, result: Result) -> None:
    """What a node took and does not hold."""
    bad = [held.words() for held in result.objects if not held.ok]
    if bad:
        fixed = "; its mapping is fixed: give canopen.rpdo and tpdo as the drive has them"
        raise NodeError(
            f"node {job.node_id} took it and holds another value: {'; '.join(bad)}"
            f"{fixed if job.plan.fixed else ''}; nothing is enabled"
        )


def limit_problems(job: Job, sdo: Sdo, scales: Scales) -> list[str]:
    """A torque that the drive would cut off reads as load: its own limit must be the larger one."""
    if job.config.drive.takes != "torque":
        return []
    raw, scale = sdo.optional_int(MOST_TORQUE), scales.of(TORQUE)
    if raw is None or scale is None:
        return []
    top, most = float(raw * scale.factor), job.config.command.most
    if most <= top:
        return []
    return [
        f"limits.i_max_a asks for up to {most:.4g} N m, the drive cuts off at {top:.4g} N m (6072h), which "
        "reads as load: lower it, or raise 6072h"
    ]


def dbc_problems(job: Job, result: Result) -> list[str]:
    """Where the DBC that a run reads says else than the node's frames are."""
    path = job.base / job.config.drive.dbc
    remedy = f"write it: hil configure CONFIG --dbc {path}"
    if not path.is_file():
        return [f"{path}: there is no such DBC yet; {remedy}"]
    try:
        found = differences(result.text, path, job.node_id, job.plan)
    except DriverError as error:
        return [f"{error}; {remedy}"]
    return [f"{one}; {remedy}" for one in found]
