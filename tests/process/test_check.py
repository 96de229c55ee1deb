"""`hil check` as a process beside real drives, and its rows on facts and traffic made by hand."""

from __future__ import annotations

import json
import os
import select
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.kernel import InterfaceFacts
from drivers.listen import Heard, Traffic
from drivers.local import open_sockets
from hil.check.checks import bus_rows, interface_rows, load_row, passed, traffic_rows
from hil.check.preflight import Row, clock_row, disk_row, softirq_policies, softirq_row, sync_rows
from hil.config.loop import BusTable
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.sim.demo import emulator_process
from tests.process.test_run import call, flags

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
WELL = InterfaceFacts("can0", "can", True, 16, 10, "ERROR-ACTIVE", 1_000_000, None, 0, 0, 0, 0)


def checked(path: Path, own: tuple[str, ...]) -> tuple[int, dict[str, dict[str, Any]], str]:
    """Exit code and rows by name of `hil check --json`."""
    done = call("check", str(path), "--json", *flags(own))
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, {r["check"]: r for r in json.loads(done.stdout)["rows"]}, done.stderr


def verdicts(rows: list[Row]) -> dict[str, str]:
    return {r.check: r.verdict for r in rows}


def setup_of(configs: Path, settings: Settings, *more: str) -> Setup:
    return load_setup(configs / "demo.toml", Overrides(settings=settings(*more)))


def test_a_sync_drive_is_ready_and_nothing_is_sent(configs: Path, settings: Settings, channel: str) -> None:
    own, path = settings("drive.heartbeat_timeout_s=1.0"), configs / "demo.toml"
    receiving, sending = open_sockets(channel, own=True)
    sending.close()
    try:
        with emulator_process(path, Overrides(settings=own)):
            code, rows, _ = checked(path, own)
            senders = set()
            while select.select([receiving], [], [], 0.05)[0]:
                senders.add(receiving.recvfrom(128)[1])
    finally:
        receiving.close()
    assert code == 0
    assert len(senders) == 1, "hil check sent something"
    assert "emulated" in rows["interface"]["found"] and rows["drive"]["verdict"] == "pass"
    assert rows["feedback rate"]["verdict"] == "warn" and rows["drive state"]["verdict"] == "warn"
    assert "unknown before SYNC: its node is operational" in rows["drive state"]["found"]
    assert set(rows) >= {"bus load", "frames", "other controller", "clock", "disk", "supply and heat"}
    assert all(set(r) == {"check", "verdict", "found", "remedy"} for r in rows.values())
    assert all(bool(r["remedy"]) == (r["verdict"] != "pass") for r in rows.values())


@pytest.mark.long
def test_a_cyclic_drive_shows_everything(configs: Path, settings: Settings) -> None:
    """It listens for 5 s: if the host holds the emulator up for up to half a second, no verdict changes."""
    own = settings("drive.heartbeat_timeout_s=5.0", 'loop.pacing="feedback"')
    path = configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own), ('pacing="cyclic"',)):
        code, rows, _ = checked(path, own)
    assert code == 0, [r for r in rows.values() if r["verdict"] == "fail"]
    for name in ("feedback rate", "frames", "protocol version", "speed and current", "supply and heat"):
        assert rows[name]["verdict"] == "pass", rows[name]


def test_without_a_drive_it_fails(configs: Path, settings: Settings) -> None:
    code, rows, _ = checked(configs / "demo.toml", settings("drive.heartbeat_timeout_s=0.3"))
    assert code == 1
    assert rows["drive"]["verdict"] == "fail" and "heard nothing" in rows["drive"]["found"]
    assert rows["drive state"]["verdict"] == "fail"


def test_an_interface_that_is_not_there(configs: Path, settings: Settings) -> None:
    code, rows, _ = checked(configs / "can0.toml", settings('bus.channel="nonecan9"'))
    assert code == 1
    assert rows["interface"]["found"] == "there is no interface nonecan9"
    assert rows["drive"]["verdict"] == "fail"


@pytest.mark.long
def test_a_slow_pll_is_refused_unless_it_is_told(configs: Path, settings: Settings) -> None:
    """VESC's default PLL: a run that does not know it is refused; one that knows it is told its margins."""
    pll = 'kind="pll",pole_1_rad_s=15.0,pole_2_rad_s=1985.0'
    path, plant = configs / "current.toml", configs / "plants" / "current.toml"
    own = settings("drive.heartbeat_timeout_s=0.2")
    for command in ("check", "run"):
        done = call(command, str(path), *flags((*own, f"drive.speed_filter={{{pll},modelled=false}}")))
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
        assert "drive.speed_filter: the loop is not stable through a PLL" in done.stderr
    text = plant.read_text(encoding="utf-8")
    plant.write_text(
        text.replace("[firmware]\n", f"[firmware]\nspeed_filter = {{ {pll} }}\n"), encoding="utf-8"
    )
    _, rows, _ = checked(path, own)
    assert rows["speed filter"]["verdict"] == "fail" and "tells no filter" in rows["speed filter"]["found"]
    _, rows, _ = checked(path, (*own, f"drive.speed_filter={{{pll}}}"))
    found = rows["speed filter"]["found"]
    assert "which the observer knows: Ms 1.79, gain margin" in found and "delay" in found


def test_the_table_keeps_its_brackets(configs: Path, settings: Settings) -> None:
    own = settings("drive.heartbeat_timeout_s=0.3", 'log.folder="/proc/none"')
    done = call("check", str(configs / "demo.toml"), *flags(own))
    assert done.returncode == 1 and "[log] folder" in done.stdout


@pytest.mark.parametrize(
    ("change", "row"),
    [
        ({"up": False}, "interface"),
        ({"state": "ERROR-PASSIVE"}, "bus state"),
        ({"state": "BUS-OFF"}, "bus state"),
        ({"bitrate": 500_000}, "bitrate"),
        ({"restart_ms": 100}, "restart-ms"),
        ({"queue_length": 1000}, "transmit queue"),
    ],
)
def test_each_fault_of_an_interface_fails_its_row_alone(change: dict[str, Any], row: str) -> None:
    bus = BusTable(interface="socketcan", channel="can0")
    assert passed(interface_rows(WELL, bus))
    found = verdicts(interface_rows(replace(WELL, **change), bus))
    assert {name for name, verdict in found.items() if verdict != "pass"} == {row}


def test_can_fd_needs_its_data_bitrate() -> None:
    bus = BusTable(interface="socketcan", channel="can0", fd=True, data_bitrate=2_000_000)
    fd = replace(WELL, mtu=72, data_bitrate=2_000_000)
    assert passed(interface_rows(fd, bus))
    for sick in (WELL, replace(fd, mtu=16), replace(fd, data_bitrate=4_000_000)):
        assert verdicts(interface_rows(sick, bus))["CAN FD"] == "fail"


def test_other_adapters_are_a_warning(configs: Path, settings: Settings) -> None:
    setup = setup_of(configs, settings, 'bus.interface="slcan"')
    assert verdicts(bus_rows(setup)) == {"interface": "warn"}


@pytest.mark.parametrize(
    ("more", "percent", "verdict"),
    [
        ((), 35, "pass"),  # 65 + 135 + 135 bits a tick, 13.5 of STATUS, heartbeats
        (("bus.bitrate=500_000",), 70, "pass"),
        (("loop.rate_hz=1250", "bus.bitrate=500_000"), 87, "fail"),
        (("bus.bitrate=250_000",), 140, "fail"),
    ],
)
def test_bus_load(
    configs: Path, settings: Settings, more: tuple[str, ...], percent: int, verdict: str
) -> None:
    row = load_row(setup_of(configs, settings, *more))
    assert row.found.startswith(f"{percent} %") and row.verdict == verdict, row


def cyclic(**values: float) -> Traffic:
    """What a drive in order sends, with some values changed."""
    feedback = {"Speed": 0.0, "CurrentQ": 0.0, "CurrentD": 0.0, "State": 1, "Counter": 3}
    status = {"ProtocolVersion": 1, "DcLinkVoltage": 560.0, "TemperatureMotor": 25.0, "ErrorCode": 0}
    status |= {"TemperatureInverter": 30.0}
    second = 1_000_000_000
    of = {
        "FEEDBACK": Heard(1001, first_ns=1, last_ns=second + 1, values=feedback),
        "STATUS": Heard(101, first_ns=1, last_ns=second + 1, values=status),
    }
    for name, value in values.items():
        next(h for h in of.values() if name in h.values).values[name] = value
    return Traffic(of)


@pytest.mark.parametrize(
    ("values", "row", "verdict"),
    [
        ({"State": 7}, "drive state", "fail"),
        ({"State": 4}, "drive state", "warn"),
        ({"ErrorCode": 0x8130}, "drive state", "fail"),
        ({"ProtocolVersion": 2}, "protocol version", "fail"),
        ({"Speed": 151.0}, "speed and current", "fail"),
        ({"CurrentD": -16.0}, "speed and current", "fail"),
        ({"DcLinkVoltage": 24.0}, "supply and heat", "fail"),
        ({"DcLinkVoltage": 700.0}, "supply and heat", "fail"),
        ({"TemperatureInverter": 111.0}, "supply and heat", "fail"),
    ],
)
def test_each_implausible_value_is_seen(
    configs: Path, settings: Settings, values: dict[str, float], row: str, verdict: str
) -> None:
    setup = setup_of(configs, settings, 'loop.pacing="feedback"')
    assert set(verdicts(traffic_rows(setup, cyclic())).values()) == {"pass"}
    found = verdicts(traffic_rows(setup, cyclic(**values)))
    assert {name: v for name, v in found.items() if v != "pass"} == {row: verdict}


def test_what_a_drive_does_not_send_is_not_zero(configs: Path, settings: Settings) -> None:
    path = configs / "inverter.toml"
    heat = 'temperature_inverter = "Supply.InverterTemperature"\n'
    text = path.read_text().replace('temperature_motor = "Supply.MotorTemperature"\n', "").replace(heat, "")
    path.write_text(text.replace("temperature_max_c = 110.0\n", ""))
    setup = load_setup(path, Overrides(settings=settings()))
    state = Heard(
        1001, first_ns=1, last_ns=1_000_000_001, values={"Mode": 0.0, "Rpm": 0.0, "Iq": 0.0, "Id": 0.0}
    )
    supply = Heard(101, first_ns=1, last_ns=1_000_000_001, values={"Udc": 560.0})
    (row,) = (
        r for r in traffic_rows(setup, Traffic({"MotorState": state, "Supply": supply})) if "heat" in r.check
    )
    assert row.verdict == "warn" and "no temperature" in row.found and " 0 degC" not in row.found


@pytest.mark.parametrize(("beat", "verdict"), [(5, "warn"), (127, "warn")])
def test_a_node_that_is_operational_may_be_a_drive_in_fault(
    configs: Path, settings: Settings, beat: int, verdict: str
) -> None:
    setup = setup_of(configs, settings)
    beats = {"HEARTBEAT": Heard(10, values={"NmtState": float(beat)})}
    (row,) = (r for r in traffic_rows(setup, Traffic(dict(beats))) if r.check == "drive state")
    assert row.verdict == verdict and ("in FAULT, too" in row.found) == (beat == 5)
    told = beats | {"EMCY": Heard(1, data=bytes.fromhex("3081010000000000"))}
    (row,) = (r for r in traffic_rows(setup, Traffic(told)) if r.check == "drive state")
    assert (
        row.verdict == "fail"
        and "0x8130, life guard" in row.found
        and "by its emergency message" in row.found
    )
    gone = beats | {"EMCY": Heard(1, data=bytes(8))}
    assert verdicts(traffic_rows(setup, Traffic(gone)))["drive state"] == "warn"


def test_a_length_that_is_not_the_dbcs_is_named(configs: Path, settings: Settings) -> None:
    setup = setup_of(configs, settings, 'loop.pacing="feedback"')
    traffic = cyclic()
    traffic.messages["FEEDBACK"].odd_length = 12
    (row,) = (r for r in traffic_rows(setup, traffic) if r.check == "length FEEDBACK")
    assert row.verdict == "fail" and row.found == "FEEDBACK: length 12, DBC 8"


def test_what_goes_out_unmapped_is_shown(configs: Path, settings: Settings) -> None:
    path = configs / "drives/inverter_fd.dbc"
    alive = ' SG_ Alive : 71|4@0+ (1,0) [0|15] "" Inverter\n'
    text = path.read_text().replace(alive, alive + ' SG_ Limit : 79|8@0+ (0.5,-10) [-10|100] "A" Inverter\n')
    text += 'BA_DEF_ SG_ "GenSigStartValue" INT 0 255;\nBA_ "GenSigStartValue" SG_ 2566852864 Limit 220;\n'
    path.write_text(text)
    setup = load_setup(configs / "inverter.toml", Overrides(settings=settings()))
    (row,) = (r for r in traffic_rows(setup, Traffic()) if r.check == "start values")
    assert row.found == "Demand.Limit = 100 A (GenSigStartValue)"


def test_rate_damage_and_another_controller_are_seen(configs: Path, settings: Settings) -> None:
    setup = setup_of(configs, settings, 'loop.pacing="feedback"')
    slow, damaged, other, down = cyclic(), cyclic(), cyclic(), cyclic()
    slow.messages["FEEDBACK"].count = 801
    damaged.messages["FEEDBACK"].invalid = 1
    other.messages["COMMAND"] = Heard(1, first_ns=1, last_ns=1)
    down.down = True
    assert verdicts(traffic_rows(setup, slow))["feedback rate"] == "fail"
    assert verdicts(traffic_rows(setup, damaged))["frames"] == "fail"
    assert verdicts(traffic_rows(setup, other))["other controller"] == "warn"
    assert verdicts(traffic_rows(setup, down))["drive"] == "fail"


def test_damaged_frames_and_counter_jumps_on_a_bus(configs: Path, settings: Settings, channel: str) -> None:
    from drivers.bus import open_link
    from drivers.listen import listen
    from hil.runtime.bus import bus_settings

    setup = setup_of(configs, settings)
    feedback = setup.database.message("FEEDBACK")
    link = open_link(bus_settings(setup.config))
    with can.Bus(interface="hil-local", channel=channel) as bus:
        for counter in (0, 1, 2, 4, 4):
            data = feedback.encode({"Counter": counter, "Speed": 1.5})
            bus.send(can.Message(arbitration_id=0x181, data=data, is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x181, data=bytes(8), is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x181, data=bytes(3), is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x555, data=bytes(3), is_extended_id=False))
        bus.send(can.Message(is_error_frame=True, is_extended_id=False))
        traffic = listen(link, setup.database, 0.2, setup.binding.counters)
    link.close()
    heard = traffic.of("FEEDBACK")
    assert (heard.count, heard.invalid, heard.jumps) == (7, 2, 2)
    assert heard.values["Speed"] == 1.5 and traffic.foreign == 1 and traffic.error_frames == 1


def test_a_sync_by_the_kernel_wants_softirqs_that_do_not_wait(tmp_path: Path) -> None:
    """Before Linux 6.5 they wait for ksoftirqd, which waits for its turn unless it is under FIFO (1)."""
    for pid, (name, policy) in enumerate({"ksoftirqd/0": 1, "ksoftirqd/1": 0, "an (odd) name": 1}.items()):
        folder = tmp_path / str(pid)
        folder.mkdir()
        numbers = " ".join(["0"] * 37)
        (folder / "stat").write_text(f"{pid} ({name}) S {numbers} {policy} 0 0")
    assert softirq_row([0], "6.1.0-56-amd64", tmp_path).verdict == "pass"
    found = softirq_row([0, 1, 2], "6.1.0-56-amd64", tmp_path)
    assert found.verdict == "warn" and found.found.endswith("ksoftirqd under FIFO but on [1, 2]")
    assert "chrt -f -p 1 $(pgrep -x ksoftirqd/1); chrt" in found.remedy
    assert softirq_row([1], "6.5.1", tmp_path).verdict == "pass"
    assert softirq_row([1], "6.12.0", tmp_path).verdict == "pass"


def test_the_kernels_threads_are_found() -> None:
    """In a container there may be none to see."""
    assert set(softirq_policies(Path("/proc"))) <= set(range(os.cpu_count() or 1))


def test_sync_by_the_loop_asks_nothing_of_softirqs() -> None:
    assert sync_rows(BusTable(), None) == []
    assert [row.check for row in sync_rows(BusTable(sync="kernel"), 0)] == ["softirqs"]


def test_clock_and_disk(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.write_text("hpet\n")
    assert clock_row(1_000_000, source).verdict == "warn"
    assert clock_row(1, tmp_path / "none").verdict == "warn"
    assert clock_row(10**12, tmp_path / "none").verdict == "pass"
    assert disk_row(tmp_path / "a.mcap", 1000).verdict == "pass"
    assert disk_row(tmp_path / "a.mcap", 1 << 60).verdict == "fail"
    assert list(tmp_path.iterdir()) == [source]


def test_rights_are_given_back() -> None:
    import os

    from hil.config.loop import RealtimeTable
    from hil.runtime.realtime import probe

    before = os.sched_getaffinity(0)
    probe(RealtimeTable(fifo_priority=1, cpu=min(before)))
    assert os.sched_getaffinity(0) == before
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    status = Path("/proc/self/status").read_text(encoding="ascii")
    assert "VmLck:\t       0 kB" in status
