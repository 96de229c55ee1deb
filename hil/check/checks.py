"""`hil check`: everything that can be known before arming, as rows of pass, warn or fail.

Sends nothing, but for questions by SDO to a drive that has a ``[canopen]`` table.
"""

from __future__ import annotations

import math
from dataclasses import replace

from rich.table import Table
from rich.text import Text

from drivers.binding import Binding
from drivers.bus import open_link
from drivers.drive import drive_kind
from drivers.errors import DriverError, LinkError
from drivers.kernel import InterfaceFacts, interface_facts
from drivers.listen import Heard, Traffic, listen, part_values
from drivers.mapping import MEASURED
from hil.check.angle import angle_rows
from hil.check.filtered import filter_rows
from hil.check.preflight import Row, Verdict, clock_row, disk_row, realtime_rows, row, sync_rows
from hil.check.seldom import seldom_rows
from hil.check.shaft import shaft_rows
from hil.config.limits import LimitsTable
from hil.config.loop import BusTable
from hil.control.law import CASCADE, PI
from hil.errors import ConfigError, HilError, plain
from hil.runtime.bus import bus_settings, is_emulated_bus
from hil.runtime.header import log_path
from hil.runtime.nodesetup import Nodes, nodes_load
from hil.runtime.refusals import LOAD_REMEDY, load_found, needed_bytes
from hil.runtime.setup import Setup
from hil.signals import DriveState
from hil.sim.emulate import load_plant
from hil.tick.errorcodes import words

PROTOCOL_VERSION = 1
MAX_QUEUE = 32
RATE_TOLERANCE = 0.1
NMT_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
OPERATIONAL = 5
HEAT = ("temperature_motor", "temperature_inverter")
FAULTS = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
MOST_MS = 3.0
"""Peak of the sensitivity in the worst corner without a warning: a phase margin of 19 deg at least."""
UNASKED = "it speaks when it is asked: hil run asks it before arming, and enables no drive in FAULT"
SILENT = "a drive that only answers SYNC or commands can't show it before arming; nothing to do"


def check(setup: Setup) -> list[Row]:
    """All rows of a configuration; listens for ``drive.heartbeat_timeout_s`` and sends no command."""
    config = setup.config
    return [
        *bus_rows(setup),
        *reach_rows(setup),
        *speed_filter_rows(setup),
        *seldom_rows(setup),
        *shaft_rows(setup),
        *angle_rows(setup),
        load_row(setup),
        *adaptive_rows(setup),
        *heard_rows(setup),
        *canopen_rows(setup),
        *realtime_rows(config.realtime),
        *sync_rows(config.bus, config.realtime.cpu),
        clock_row(config.loop.period_ns),
        disk_row(log_path(setup, "check"), needed_bytes(config)),
    ]


def check_nodes(setups: Nodes) -> list[Row]:
    """:func:`check` of several nodes: each one's rows with its name, bus load and machine once."""
    (_, first), *_ = setups.items()
    config = first.config
    rows = bus_rows(first)
    for name, setup in setups.items():
        own = [*reach_rows(setup), *speed_filter_rows(setup), *shaft_rows(setup), *adaptive_rows(setup)]
        own += [*angle_rows(setup), *heard_rows(setup), *canopen_rows(setup)]
        rows += [replace(one, check=f"{name}: {one.check}") for one in own]
    found, good = nodes_load(setups)
    rows += [row("bus load", good, found, LOAD_REMEDY), *realtime_rows(config.realtime)]
    needed = len(setups) * needed_bytes(config)
    return [*rows, clock_row(config.loop.period_ns), disk_row(log_path(first, "check"), needed)]


def reach_rows(setup: Setup) -> list[Row]:
    """What the configuration asks for and can't get; on a bus that may be real no run starts with it."""
    if not setup.warnings:
        return [Row("reference and poles", "pass", "within the limits of speed, voltage and sampling")]
    verdict: Verdict = "warn" if is_emulated_bus(setup.config) else "fail"
    return [Row("reference and poles", verdict, *line.rsplit("; ", 1)) for line in setup.warnings]


def speed_filter_rows(setup: Setup) -> list[Row]:
    """What the filter of the drive's speed does to the loop; an emulated drive's own is known."""
    config = setup.config
    if config.emulator is None or config.drive.takes == "voltage" or not is_emulated_bus(config):
        return filter_rows(setup)
    try:
        plant, _ = load_plant(setup.path, config)
    except ConfigError as error:
        return [Row("speed filter", "warn", str(error), "correct emulator.plant")]
    return filter_rows(setup, plant.firmware.filtered_by, plant.sensors.w_noise_rad_s)


def passed(rows: list[Row]) -> bool:
    """True when no row fails."""
    return all(r.verdict != "fail" for r in rows)


def check_table(rows: list[Row]) -> Table:
    """The rows for a terminal."""
    asked = any(r.check.endswith("canopen") for r in rows)
    sent = "asked by SDO, nothing else was sent" if asked else "nothing was sent"
    table = Table(title=f"hil check ({sent})", title_justify="left")
    for title in ("check", "verdict", "found", "remedy"):
        table.add_column(title, overflow="fold")
    for r in rows:
        verdict = Text(r.verdict, style=STYLES[r.verdict])
        table.add_row(r.check, verdict, Text(plain(r.found)), Text(plain(r.remedy)))
    return table


def bus_rows(setup: Setup) -> list[Row]:
    """Rows about the interface, from the kernel."""
    bus = setup.config.bus
    where = f"{bus.interface}:{bus.channel}"
    if is_emulated_bus(setup.config):
        return [Row("interface", "pass", f"{where} is emulated: it has no bitrate, restart or bus state")]
    if bus.interface != "socketcan":
        remedy = "check bitrate and bus state with the adapter's own tool"
        return [Row("interface", "warn", f"{where}: the kernel knows nothing of it", remedy)]
    try:
        facts = interface_facts(bus.channel)
    except DriverError as error:
        return [Row("interface", "warn", str(error), "install iproute2 and check again")]
    if facts is None:
        remedy = "plug in the adapter and load its driver; list interfaces with ip link"
        return [Row("interface", "fail", f"there is no interface {bus.channel}", remedy)]
    return interface_rows(facts, bus)


def interface_rows(facts: InterfaceFacts, bus: BusTable) -> list[Row]:
    """Rows of one CAN interface: up, bus state, bitrates, restart, queue."""
    name = facts.name
    down = f"ip link set {name} down; ip link set {name} type can"
    tx, rx, off = facts.tx_errors or 0, facts.rx_errors or 0, facts.bus_off_count or 0
    counters = f"error counters tx {tx} rx {rx}, {off} times bus-off"
    rows = [
        row("interface", facts.up, f"{name} is {'up' if facts.up else 'down'}", f"ip link set {name} up"),
        row(
            "bus state",
            facts.state in (None, "ERROR-ACTIVE"),
            f"{facts.state}, {counters}",
            "check wiring, 120 ohm at both ends, bitrate; then take the interface down and up",
        ),
        row(
            "bitrate",
            facts.bitrate == bus.bitrate,
            f"{facts.bitrate} bit/s, configured {bus.bitrate}",
            f"{down} bitrate {bus.bitrate}",
        ),
        row(
            "restart-ms",
            facts.restart_ms in (None, 0),
            f"{facts.restart_ms} ms",
            f"{down} restart-ms 0: after bus-off nothing may be sent by itself",
        ),
        row(
            "transmit queue",
            facts.queue_length <= MAX_QUEUE,
            f"{facts.queue_length} frames",
            f"ip link set {name} txqueuelen 10: old commands must not wait out a bus outage",
        ),
    ]
    return rows + ([_fd_row(facts, bus)] if bus.fd else [])


def _fd_row(facts: InterfaceFacts, bus: BusTable) -> Row:
    wanted = bus.data_bitrate or facts.data_bitrate
    good = facts.mtu >= 72 and facts.data_bitrate is not None and facts.data_bitrate == wanted
    found = f"mtu {facts.mtu}, data bitrate {facts.data_bitrate}, configured {bus.data_bitrate}"
    remedy = f"ip link set {facts.name} down; ip link set {facts.name} type can dbitrate {wanted} fd on"
    return row("CAN FD", good, found, remedy)


def load_row(setup: Setup) -> Row:
    """Worst-case bus load of this run; other nodes' frames come on top."""
    found, good = load_found(setup)
    return row("bus load", good, found, LOAD_REMEDY)


def adaptive_rows(setup: Setup) -> list[Row]:
    """Rows about an adaptive window: is its noise that of the frames at least, is it stable."""
    from hil.tuning.measure import adapts

    law = setup.machine.law
    if not adapts(law):
        return []
    rows = [noise_row(setup)]
    if int(law["kind"][0]) in (CASCADE, PI):
        rows.append(modes_row(setup))
    return rows


def noise_row(setup: Setup) -> Row:
    """Thresholds below the resolution take every step of it for a load."""
    observer = setup.config.observer
    tables = [observer.speed, observer.speed if observer.current is None else observer.current]
    w_lsb, q_lsb, d_lsb = setup.wire.x_lsb
    least = w_lsb / math.sqrt(12.0), max(q_lsb, d_lsb) / math.sqrt(12.0)
    told = [
        (getattr(table, key), low)
        for table in tables
        if table.kind == "adaptive"
        for key, low in zip(("w_noise_rad_s", "i_noise_a"), least, strict=True)
    ]
    found = f"resolution alone: w_noise_rad_s = {least[0]:.3g}, i_noise_a = {least[1]:.3g}"
    remedy = "observer: give the noise that is measured at constant speed, the resolution included"
    return row("adaptive noise", all(value >= 0.99 * low for value, low in told), found, remedy, "warn")


def modes_row(setup: Setup) -> Row:
    """The loop of the short window and that of the long one, with the motor believed in and +-30 %."""
    from hil.tuning.bench import bench_of
    from hil.tuning.measure import loops

    bench = bench_of(setup.path, setup)
    nominal, *corners = loops(setup.machine.law, bench, bench.plants())
    worst = max(loop.ms for loop in corners)
    found = (
        f"Ms {nominal.ms:.2f}, {worst:.2f} with J, psi_f, R_s, L off by 30 %, at most {MOST_MS:g} wanted; "
        "inf is unstable"
    )
    remedy = "lengthen short_ms, shorten delay_ms or slow the poles: hil design --law adaptive"
    if not nominal.stable:
        return Row("adaptive window", "fail", found, remedy)
    return row("adaptive window", worst <= MOST_MS, found, remedy, "warn")


def heard_rows(setup: Setup) -> list[Row]:
    """Rows about the drive, from listening."""
    config = setup.config
    try:
        link = open_link(bus_settings(config))
    except LinkError as error:
        return [Row("drive", "fail", str(error), "bring the interface up, then check again")]
    try:
        traffic = listen(link, setup.database, config.drive.heartbeat_timeout_s, setup.binding.counters)
    finally:
        link.close()
    return traffic_rows(setup, traffic)


def canopen_rows(setup: Setup) -> list[Row]:
    """One row for a CANopen drive that hil configure has set; it is asked by SDO."""
    config = setup.config
    if config.canopen is None:
        return []
    from hil.runtime.configure import looked_at

    try:
        node = looked_at(setup.path, config, bus_settings(config), 0.0)
    except (DriverError, HilError) as error:
        return [Row("canopen", "fail", str(error), "see what it says; then hil configure, hil check")]
    if problems := "; ".join(node.problems):
        return [Row("canopen", "fail", problems, f"set it: hil configure {setup.path}")]
    found = f"mode {node.mode}, every object as hil configure sets it"
    if node.fault is not None:
        found += f"; it stands in fault, error {words(node.fault)}"
    return [row("canopen", node.fault is None, found, "see to its cause; the next arming resets it")]


def traffic_rows(setup: Setup, traffic: Traffic) -> list[Row]:
    """Rows about what was heard."""
    config = setup.config
    silent_ok = config.loop.pacing == "sync"
    values = part_values(setup.binding, traffic)
    asked = drive_kind(config.drive.kind).asked
    return [
        drive_row(traffic, setup.binding, config.drive.heartbeat_timeout_s, asked),
        *feedback_rows(setup, traffic, silent_ok),
        *([] if silent_ok else unheard_rows(traffic, setup.binding)),
        frames_row(traffic),
        *length_rows(traffic, setup.binding),
        *started_rows(setup.binding),
        *unwatched_rows(setup.binding),
        others_row(traffic, setup.binding),
        state_row(traffic, setup.binding, values, asked),
        *version_rows(setup, traffic, silent_ok),
        motion_row(values, config.limits, silent_ok),
        *supply_rows(setup.binding, values, config.limits, silent_ok),
    ]


def feedback_rows(setup: Setup, traffic: Traffic, silent_ok: bool) -> list[Row]:
    """One row for each message with measurements."""
    config, parts = setup.config, setup.binding.incoming
    rate_hz, every = config.loop.rate_hz / config.feedback_every, config.feedback_every
    what = "loop" if every == 1 else "feedback.period_ms"
    measuring = [b.message for b in parts if any(part in MEASURED for part, _ in b.parts)]
    rows = [feedback_row(traffic.of(m.name), rate_hz, silent_ok, what, m.set_by) for m in measuring]
    if len(rows) == 1:
        return rows
    return [replace(r, check=f"{r.check} {m.name}") for m, r in zip(measuring, rows, strict=True)]


def unheard_rows(traffic: Traffic, binding: Binding) -> list[Row]:
    """One row for each slower message that a drive which speaks does not send, and by what it is set."""
    if not any(traffic.of(bound.message.name).count for bound in binding.incoming):
        return []
    slow = [b.message for b in binding.incoming if all(part not in MEASURED for part, _ in b.parts)]
    return [
        Row(f"rate {m.name}", "fail", f"no {m.name}", f"set {m.set_by} = {m.cycle_ms:g} in the drive")
        for m in slow
        if m.set_by and m.cycle_ms and traffic.of(m.name).count == 0
    ]


def drive_row(traffic: Traffic, binding: Binding, seconds: float, asked: bool = False) -> Row:
    """Is there a drive at all; one that speaks when it is asked can't tell."""
    messages = [binding.heartbeat, *(bound.message for bound in binding.incoming)]
    names = [message.name for message in messages if message and traffic.of(message.name).count]
    remedy = "is it powered, wired and terminated; are node id and bitrate right?"
    if traffic.down:
        return Row("drive", "fail", "the bus went down while listening", remedy)
    found = f"heard {', '.join(names) or 'nothing'} in {seconds:g} s, {traffic.foreign} frames not in the DBC"
    if not names and (asked or binding.map.poll):
        return Row("drive", "warn", found, UNASKED if asked else SILENT)
    return row("drive", bool(names), found, remedy)


def feedback_row(
    feedback: Heard, rate_hz: float, silent_ok: bool, what: str = "loop", set_by: str = ""
) -> Row:
    """Does feedback come at the rate of the loop, or at that of feedback.period_ms.

    ``set_by``: the drive's parameter of it, [ms].
    """
    own = f"set {set_by} = {1000.0 / rate_hz:g} in the drive" if set_by else ""
    if feedback.count == 0:
        if silent_ok:
            return Row("feedback rate", "warn", "no feedback: it comes with SYNC only", SILENT)
        remedy = own or "switch on the drive's cyclic transmission"
        return Row("feedback rate", "fail", "no feedback", remedy)
    near = abs(feedback.rate_hz / rate_hz - 1.0) <= RATE_TOLERANCE
    found = f"{feedback.rate_hz:.0f} Hz, {what} {rate_hz:g} Hz"
    remedy = (
        f"{own}, or feedback.period_ms"
        if own
        else "set loop.rate_hz, the drive's cycle time or feedback.period_ms"
    )
    return row("feedback rate", near, found, remedy)


def frames_row(traffic: Traffic) -> Row:
    """Are the frames whole: CRC, length, counter, error frames."""
    heard = traffic.messages.values()
    invalid, jumps = sum(h.invalid for h in heard), sum(h.jumps for h in heard)
    errors = traffic.error_frames
    found = f"{sum(h.count for h in heard)} frames: {invalid} damaged, {jumps} counter jumps, {errors} errors"
    good = invalid == jumps == errors == 0
    return row("frames", good, found, "is the DBC the drive's own; wiring, termination, a second drive?")


def length_rows(traffic: Traffic, binding: Binding) -> list[Row]:
    """One row for each mapped message that comes with another length than the DBC says."""
    remedy = "correct the DBC's length: no frame of this one is taken"
    lengths = {b.message.name: b.message.length for b in (*binding.incoming, *binding.outgoing)}
    odd = [(name, traffic.of(name).odd_length, length) for name, length in lengths.items()]
    return [
        Row(f"length {name}", "fail", f"{name}: length {came}, DBC {length}", remedy)
        for name, came, length in odd
        if came is not None
    ]


def started_rows(binding: Binding) -> list[Row]:
    """What goes out with each command though the map does not name it."""
    said = [
        f"{bound.message.name}.{name} = {value:g} {unit}".rstrip()
        for bound in binding.outgoing
        for name, value, unit in bound.payload.started
    ]
    return [Row("start values", "pass", f"{', '.join(said)} (GenSigStartValue)")] if said else []


def unwatched_rows(binding: Binding) -> list[Row]:
    """A command that goes on acting when its master has died."""
    why = binding.command.message.unwatched
    return [Row("watchdog", "warn", why, "take a mode of the drive that it watches")] if why else []


def others_row(traffic: Traffic, binding: Binding) -> Row:
    """Does somebody else command the drive."""
    messages = [binding.sync, *(bound.message for bound in binding.outgoing)]
    names = [message.name for message in messages if message and traffic.of(message.name).count]
    found = f"{', '.join(names)} heard" if names else "none heard"
    remedy = "stop it before arming; hil run --shadow may run beside it"
    return row("other controller", not names, found, remedy, "warn")


def state_row(traffic: Traffic, binding: Binding, values: dict[str, float], asked: bool = False) -> Row:
    """State of the drive, from feedback or else from its heartbeat."""
    remedy = "clear the drive's fault and its cause first"
    if "state" in values:
        state, error = DriveState(int(values["state"])), int(values.get("error", 0))
        found = state.name.lower().replace("_", " ") + (f", error {words(error)}" if error else "")
        if state == DriveState.OPERATION_ENABLED:
            return Row("drive state", "warn", found, "somebody has enabled it; disable it before arming")
        return row("drive state", state not in FAULTS and not error, found, remedy)
    if code := _emergency(traffic, binding):
        return Row("drive state", "fail", f"error {words(code)} by its emergency message", remedy)
    beat = _nmt_state(traffic, binding)
    if beat is None and binding.map.poll:
        return Row("drive state", "warn", "unknown: it answers when it is asked, after arming", SILENT)
    if beat is None and asked:
        return Row("drive state", "warn", "unknown before it is asked", UNASKED)
    if beat is None:
        return Row("drive state", "fail", "unknown: nothing heard that tells it", "see the row drive")
    nmt = f"{NMT_STATES.get(int(beat), f'unknown ({beat:g})')} by its heartbeat"
    if values.get("error"):
        return Row("drive state", "fail", f"{nmt}, error {words(int(values['error']))}", remedy)
    if beat != OPERATIONAL:
        return Row("drive state", "warn", f"its node is {nmt}", "set the drive operational (NMT start)")
    found = f"unknown before SYNC: its node is {nmt}, and is that with a drive in FAULT, too"
    return Row(
        "drive state", "warn", found, "the run sees it in its first ticks and enables no drive in FAULT"
    )


def _emergency(traffic: Traffic, binding: Binding) -> int:
    """Error code of the newest emergency message (CiA 301: its first two bytes), 0 for none."""
    heard = traffic.of(binding.emergency.name) if binding.emergency else Heard()
    return int.from_bytes(heard.data[:2], "little")


def _nmt_state(traffic: Traffic, binding: Binding) -> float | None:
    """What a CANopen heartbeat, a single signal, says; None for no heartbeat or one of another form."""
    heard = traffic.of(binding.heartbeat.name).values if binding.heartbeat else {}
    return next(iter(heard.values())) if len(heard) == 1 else None


def version_rows(setup: Setup, traffic: Traffic, silent_ok: bool) -> list[Row]:
    """The house protocol's version; a drive with a map of its own has none that is known."""
    if setup.config.drive.signals is not None:
        return []
    heard = [traffic.of(bound.message.name).values for bound in setup.binding.incoming]
    return [version_row({name: v for values in heard for name, v in values.items()}, silent_ok)]


def version_row(values: dict[str, float], silent_ok: bool) -> Row:
    """Does the drive speak our version of the protocol."""
    if "ProtocolVersion" not in values:
        return _unseen("protocol version", silent_ok)
    found = f"{values['ProtocolVersion']:g}, expected {PROTOCOL_VERSION}"
    good = values["ProtocolVersion"] == PROTOCOL_VERSION
    return row("protocol version", good, found, "update the drive's firmware or take its own DBC")


def motion_row(values: dict[str, float], limits: LimitsTable, silent_ok: bool) -> Row:
    """Are speed and currents plausible before arming."""
    if "speed" not in values:
        return _unseen("speed and current", silent_ok)
    w, i = values["speed"], max(abs(values.get("i_q", 0.0)), abs(values.get("i_d", 0.0)))
    found = f"{w:.2f} rad/s of {limits.w_max_rad_s:g}, {i:.2f} A of {limits.i_max_a:g}"
    good = abs(w) < limits.w_max_rad_s and i < limits.i_max_a
    return row("speed and current", good, found, "sensor scale or offset, DBC, limits")


def supply_rows(
    binding: Binding, values: dict[str, float], limits: LimitsTable, silent_ok: bool
) -> list[Row]:
    """Are DC link and temperatures within the limits; what the drive does not send is nobody's to judge."""
    mapped = [part for part in ("v_dc", *HEAT) if binding.signal(part)]
    if not mapped:
        return []
    if not any(part in values for part in mapped):
        return [_unseen("supply and heat", silent_ok)]
    volts, degrees = values.get("v_dc"), [values[part] for part in HEAT if part in values]
    hot = max(degrees) if degrees else None
    low, high = limits.v_dc_min_v, limits.v_dc_max_v
    found = ", ".join(
        (
            f"{volts:.1f} V of {low:g} .. {high:g}" if volts is not None else "no DC-link voltage",
            f"{hot:.0f} degC" if hot is not None else "no temperature",
        )
    )
    good = (volts is None or low <= volts <= high) and all(t < limits.temperature_max_c for t in degrees)
    if not good:
        return [
            Row("supply and heat", "fail", found, "switch on the DC link, let it cool, or correct [limits]")
        ]
    if volts is None or hot is None:
        return [
            Row(
                "supply and heat",
                "warn",
                f"{found}: nothing watches it",
                "map the signal, if the drive has it",
            )
        ]
    return [Row("supply and heat", "pass", found)]


def _unseen(what: str, silent_ok: bool) -> Row:
    if silent_ok:
        return Row(what, "warn", "not seen", SILENT)
    return Row(what, "fail", "not seen", "switch on the drive's cyclic transmission")
