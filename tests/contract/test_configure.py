"""`hil configure` against the emulated CiA 402 drive, and nodes of strangers that refuse, lie or are two."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import can
import canopen
import cantools
import pytest
from canopen import SdoAbortedError

from drivers.errors import DatabaseError, NodeError
from drivers.scales import Said, Scale, Scales
from hil.check.checks import canopen_rows
from hil.cli import main
from hil.errors import ConfigError, HilError
from hil.runtime.configure import Result, compare, configure, looked_at
from hil.runtime.refusals import check_set_up
from hil.runtime.setup import Overrides, load_setup
from tests.canopen import EDS, NODE, bus_of, emulated, job, recorded, run_config, stranger

pytestmark = pytest.mark.alone

SDO_TO, SDO_FROM, NMT = 0x600 + NODE, 0x580 + NODE, 0x000


def set_up(configs: Path, channel: str, *settings: str, store: bool = False) -> Result:
    made = job(configs, channel, *settings)
    return configure(made, store=store, dbc=made.base / made.config.drive.dbc)


def writes(frames: list[can.Message]) -> list[tuple[int, int, int]]:
    """(index, sub, value) of each expedited SDO download."""
    return [
        (int.from_bytes(f.data[1:3], "little"), f.data[3], int.from_bytes(f.data[4:8], "little"))
        for f in frames
        if f.arbitration_id == SDO_TO and f.data[0] & 0xE0 == 0x20
    ]


def asked(configs: Path, channel: str, *settings: str) -> str:
    """What a set-up is refused with; nothing but reads was sent when it is refused beforehand."""
    with pytest.raises((DatabaseError, NodeError, ConfigError, HilError)) as refused:
        set_up(configs, channel, *settings)
    return str(refused.value)


def refused_untouched(configs: Path, channel: str, *settings: str) -> str:
    """The same, where nothing may have been written."""
    with recorded(channel) as frames:
        said = asked(configs, channel, *settings)
    assert not writes(frames) and NMT not in {f.arbitration_id for f in frames}
    return said


def test_a_drive_is_set_read_back_and_never_started(configs: Path, channel: str) -> None:
    with emulated(configs, channel) as node, recorded(channel) as frames:
        result = set_up(configs, channel)
        assert result.written and not result.stored and not result.problems
        assert all(held.ok for held in result.objects)
    sent = [f for f in frames if f.arbitration_id in (SDO_TO, NMT, 0x80, 0x200 + NODE)]
    assert {f.arbitration_id for f in sent} == {SDO_TO, NMT}
    assert [bytes(f.data) for f in sent if f.arbitration_id == NMT] == [bytes((0x80, NODE))]
    assert node.state["state"] == 1 and node.state["started"] == 0
    assert 0x1010 not in {index for index, _, _ in writes(frames)}


def test_pdos_are_changed_in_the_order_of_the_standard(configs: Path, channel: str) -> None:
    """CiA 301: off, no entries, entries, their number, transmission, on; by hand, for TPDO 1 of node 5."""
    with emulated(configs, channel), recorded(channel) as frames:
        set_up(configs, channel)
    of_one = [write for write in writes(frames) if write[0] in (0x1800, 0x1A00)]
    assert of_one == [
        (0x1800, 1, 0xC0000185),
        (0x1A00, 0, 0),
        (0x1A00, 1, 0x60410010),
        (0x1A00, 2, 0x606C0020),
        (0x1A00, 3, 0x60770010),
        (0x1A00, 0, 3),
        (0x1800, 2, 1),
        (0x1800, 1, 0x40000185),
    ]
    rest = [write for write in writes(frames) if write[0] not in range(0x1400, 0x1C00)]
    assert rest == [(0x60C2, 1, 1), (0x60C2, 2, 0xFD), (0x6060, 0, 10), (0x1017, 0, 100), (0x1019, 0, 0)]


def test_the_dbc_has_the_drives_units(configs: Path, channel: str) -> None:
    """Rated torque 13.68 N m and milli-rpm by the drive's own objects; read by cantools."""
    with emulated(configs, channel):
        set_up(configs, channel)
    database = cantools.database.load_file(configs / "drives" / "cia402.dbc")
    heard = database.get_message_by_name("TPDO1")
    raw = bytes.fromhex("3702") + (-1_500_000).to_bytes(4, "little", signed=True) + bytes.fromhex("f401")
    assert heard.frame_id == 0x181 and database.get_message_by_name("SYNC").length == 0
    values = heard.decode(raw)
    assert values == {"Statusword": 0x0237, "Velocity": -1500.0, "Torque": pytest.approx(6.84)}
    assert [heard.get_signal_by_name(name).unit for name in ("Velocity", "Torque")] == ["rpm", "Nm"]
    said = database.get_message_by_name("RPDO1").encode({"Controlword": 0x0F, "TargetTorque": -13.68})
    assert said == bytes.fromhex("0f0018fc")


def test_a_mapping_lost_at_power_off_is_found_and_one_stored_is_kept(configs: Path, channel: str) -> None:
    made = job(configs, channel)
    with emulated(configs, channel) as node:
        set_up(configs, channel)
        assert compare(made).problems == []
        reset(channel)
        problems = compare(made).problems
        assert "1A00h:2 is 0x0, not 0x606c0020 (TPDO1 carries 606Ch Velocity)" in problems
        found = looked_at(run_config(configs), made.config, bus_of(channel), 0.0)
        assert found.problems == problems and found.fault is None
        assert set_up(configs, channel, store=True).stored
        reset(channel)
        assert compare(made).problems == []
        assert node.state["state"] == 1


def reset(channel: str) -> None:
    """NMT: reset the node, as power-off does."""
    with can.Bus(channel, "hil-local") as bus:
        bus.send(can.Message(arbitration_id=0, data=[0x81, NODE], is_extended_id=False))
    time.sleep(0.05)


@pytest.mark.parametrize(("rate_hz", "period_us"), [(1000, 1000), (4000, 250)])
def test_the_period_of_sync_where_it_is_wanted(
    configs: Path, channel: str, rate_hz: int, period_us: int
) -> None:
    """1006h in microseconds (CiA 301): read back by strangers, too, lost at power-off, kept when stored."""
    wish = ("canopen.sync_period=true", f"loop.rate_hz={rate_hz}")
    made = job(configs, channel, *wish)
    with emulated(configs, channel), recorded(channel) as frames:
        result = set_up(configs, channel, *wish)
        with canopen.Network() as network:
            network.connect(interface="hil-local", channel=channel)
            assert network.add_node(NODE, str(EDS)).sdo[0x1006].raw == period_us
        reset(channel)
        lost = compare(made).problems
        assert set_up(configs, channel, *wish, store=True).stored
        reset(channel)
        assert compare(made).problems == []
        other = compare(job(configs, channel, "canopen.sync_period=true", "loop.rate_hz=2000")).problems
    (held,) = [one for one in result.objects if str(one.entry.place) == "1006h"]
    assert (held.wanted, held.found) == (period_us, period_us) and not result.problems
    assert (0x1006, 0, period_us) in writes(frames)
    assert f"1006h is 0x0, not {period_us:#x} (SYNC every [us])" in lost
    assert f"1006h is {period_us:#x}, not 0x1f4 (SYNC every [us])" in other


def test_strangers_hold_the_period_of_sync_or_refuse_it(configs: Path, channel: str) -> None:
    """Without the wish nobody's is touched: `test_pdos_are_changed_in_the_order_of_the_standard`."""
    with stranger(channel) as node:
        node.sdo[0x6061].raw = 10
        assert set_up(configs, channel, "canopen.sync_period=true").written
        assert node.sdo[0x1006].raw == 1000
        node.add_write_callback(refusing(0x1006, 0, 0x06090030))
        heard = asked(configs, channel, "canopen.sync_period=true")
    assert "1006h can't be set to 0x3E8: abort 0x06090030, Value range of parameter" in heard


@pytest.mark.parametrize(
    ("cob_id", "said"),
    [
        (0x40000080, "node 5 makes SYNC itself (1005h = 0x40000080)"),
        (0x81, "node 5 takes another frame as SYNC (1005h = 0x81)"),
        (0x20000080, "node 5 takes another frame as SYNC (1005h = 0x20000080)"),
    ],
)
def test_a_node_that_does_not_take_our_sync(configs: Path, channel: str, cob_id: int, said: str) -> None:
    """One that makes SYNC would begin to with the period; a bit that means nothing is no matter."""
    with stranger(channel) as node:
        node.sdo[0x1005].raw, node.sdo[0x6061].raw = cob_id, 10
        assert said in refused_untouched(configs, channel, "canopen.sync_period=true")
        with pytest.raises(NodeError, match="set its 1005h to 0x80: the controller sends SYNC"):
            compare(job(configs, channel))
        node.sdo[0x1005].raw = 0x80000080
        assert set_up(configs, channel, "canopen.sync_period=true").written


def test_comparing_changes_nothing(configs: Path, channel: str) -> None:
    with emulated(configs, channel), recorded(channel) as frames:
        assert compare(job(configs, channel)).problems
    assert not writes(frames) and NMT not in {f.arbitration_id for f in frames}


@pytest.mark.parametrize(
    ("mode", "sent", "heard"),
    [
        ("csv", [0x60400010, 0x60FF0020], [[0x60410010, 0x606C0020, 0x60770010]]),
        ("csp", [0x60400010, 0x607A0020], [[0x60410010, 0x60640020, 0x60770010], [0x606C0020]]),
    ],
)
def test_other_modes(configs: Path, channel: str, mode: str, sent: list[int], heard: list[list[int]]) -> None:
    with emulated(configs, channel), recorded(channel) as frames:
        assert set_up(configs, channel, f'canopen.mode="{mode}"').mode == mode
    entries = [
        (index, value) for index, sub, value in writes(frames) if sub and index in (0x1600, 0x1A00, 0x1A01)
    ]
    expected = [(0x1600, v) for v in sent] + [(0x1A00 + k, v) for k, row in enumerate(heard) for v in row]
    assert entries == expected
    assert (0x6060, 0, {"csv": 9, "csp": 8}[mode]) in writes(frames)


def test_more_objects_by_name_with_their_units(configs: Path, channel: str) -> None:
    own = ('canopen.tpdo=[["6041", "606Ch", "0x6077"], ["6078", "6079"]]', 'canopen.rated_current="peak"')
    with emulated(configs, channel):
        result = set_up(configs, channel, *own)
    second = cantools.database.load_file(configs / "drives" / "cia402.dbc").get_message_by_name("TPDO2")
    assert [(s.name, s.scale, s.unit) for s in second.signals] == [
        ("Current", 0.004, "A"),
        ("DcLinkVoltage", 0.001, "V"),
    ]
    assert result.units["rated_current"] == "4 A peak (6075h)"


def test_the_angle_has_the_turn_that_the_drive_tells(configs: Path, channel: str) -> None:
    with emulated(configs, channel):
        result = set_up(configs, channel, 'canopen.tpdo=[["6041", "606C", "6077"], ["6064"]]')
    second = cantools.database.load_file(configs / "drives" / "cia402.dbc").get_message_by_name("TPDO2")
    assert [(s.name, s.scale, s.unit) for s in second.signals] == [("Position", 1.0 / 4096, "rev")]
    assert result.units["unit_of_angle"] == "0.000244141 rev (608Fh)"


class Told:
    """A node that has these objects alone."""

    node_id = NODE

    def __init__(self, objects: dict[tuple[int, int], int]) -> None:
        self._objects = objects

    def optional_int(self, index: int, sub: int = 0, *, signed: bool = False) -> int | None:
        return self._objects.get((index, sub))


COUNTED = {(0x608F, 1): 10_000, (0x608F, 2): 1}


@pytest.mark.parametrize(
    ("objects", "said", "scale"),
    [
        ({}, "", None),
        ({}, "1/3000 rev", Scale(Fraction(1, 3000), "rev")),
        (COUNTED, "", Scale(Fraction(1, 10_000), "rev")),
        (COUNTED | {(0x6091, 1): 5, (0x6091, 2): 1}, "", None),
        (COUNTED | {(0x6091, 1): 5, (0x6091, 2): 1}, "1/50000 rev", Scale(Fraction(1, 50_000), "rev")),
        (COUNTED | {(0x6091, 1): 1, (0x6091, 2): 1}, "0.0001 rev", Scale(Fraction(1, 10_000), "rev")),
        ({(0x60A8, 0): 0xFD410000}, "", Scale(Fraction(1, 1000), "deg")),
        ({(0x608F, 1): 0, (0x608F, 2): 1}, "", None),
    ],
)
def test_what_an_angle_counts_in(objects: dict[tuple[int, int], int], said: str, scale: Scale | None) -> None:
    told: Any = Told(objects)
    assert Scales(told, Said(position_unit=said)).of(0x6064) == scale


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("1/4096 rev", 'canopen.position_unit = "1/4096 rev", but 608Fh says 0.0001 rev; leave the key out'),
        ("counts", 'canopen.position_unit = "counts": give a unit of rad, rev, deg'),
    ],
)
def test_an_angle_that_is_said_otherwise_is_refused(said: str, words: str) -> None:
    told: Any = Told(COUNTED)
    with pytest.raises(DatabaseError, match=re.escape(words)):
        Scales(told, Said(position_unit=said)).of(0x6064)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (['canopen.tpdo=[["6041","6078"]]'], 'canopen.rated_current: missing; 6078h counts per mille'),
        (['canopen.velocity_unit="rpm"'], "60A9h = 0xFDB44700 says 0.001 rpm"),
        (['canopen.velocity_unit="furlongs"'], "give a unit of rad/s"),
        (['canopen.tpdo=[["6041","606C","6077","6077"]]'], "TPDO1 would have 10 bytes; a frame has 8"),
        (['canopen.tpdo=[["6041","6999"]]'], "has no object 6999h (TPDO1)"),
        (['canopen.tpdo=[["6041","1017"]]'], "1017h (TPDO1) can't be mapped to a PDO"),
        (['canopen.rpdo=[["6040","606C"]]'], "606Ch (RPDO1) can't be written"),
        (['canopen.rpdo=[["6071"]]'], "6040h is in none of them"),
        (['canopen.tpdo=[["606C"]]'], "6041h is in none of them"),
        (['canopen.tpdo=[["6041"],["606C"],["6077"]]'], "has no object 1802h:1 (TPDO3)"),
        (["loop.rate_hz=16000"], "a period of 62500 ns can't be said in 60C2h"),
        (["canopen.sync_period=true", "loop.rate_hz=3200"], "312500 ns are no whole microseconds"),
        (['canopen.eds="drives/cia402.dbc"'], "is no EDS and no DCF by its name"),
        (['canopen.eds="drives/none.eds"'], "can't be read: No such file"),
        (["drive.node_id=0"], "drive.node_id = 0: CANopen has nodes 1 to 127"),
    ],
)  # fmt: skip
def test_what_is_refused_before_anything_is_changed(
    configs: Path, channel: str, settings: list[str], said: str
) -> None:
    (configs / "drives" / "cia402.dbc").touch()
    with emulated(configs, channel):
        assert said in refused_untouched(configs, channel, *settings)


@pytest.mark.parametrize("index", [0x6071, 0x606C, 0x60C2, 0x6060, 0x6061, 0x1017, 0x1800, 0x1006])
def test_an_eds_without_the_object(configs: Path, channel: str, index: int) -> None:
    path = configs / "drives" / "cia402.eds"
    text = path.read_text(encoding="utf-8").replace(f"[{index:04X}", f"[Was{index:04X}")
    path.write_text(text, encoding="utf-8")
    said = refused_untouched(configs, channel, "canopen.sync_period=true")  # by the file: there is no drive
    assert f"has no object {index:04X}h" in said and "cia402.eds" in said


@pytest.mark.parametrize("content", ["", "[", "[6041]\nParameterName=x\n", "\x00\x01"])
def test_an_eds_that_is_none(configs: Path, channel: str, content: str) -> None:
    (configs / "drives" / "cia402.eds").write_text(content, encoding="utf-8")
    assert "is no usable EDS or DCF" in refused_untouched(configs, channel)


def test_store_needs_its_object(configs: Path, channel: str) -> None:
    path = configs / "drives" / "cia402.eds"
    path.write_text(path.read_text(encoding="utf-8").replace("[1010", "[Was1010"), encoding="utf-8")
    with pytest.raises(DatabaseError, match=r"no object 1010h:1 \(store parameters\); leave --store out"):
        set_up(configs, channel, store=True)


def test_a_dcf_is_of_one_node_and_its_values_are_set(configs: Path, channel: str) -> None:
    text = (configs / "drives" / "cia402.eds").read_text(encoding="utf-8")
    dcf = configs / "drives" / "mine.dcf"
    own = text.replace("[6007]\n", "[6007]\nParameterValue=3\n")
    dcf.write_text(f"{own}\n[DeviceComissioning]\nNodeID=5\n", encoding="utf-8")
    with emulated(configs, channel):
        result = set_up(configs, channel, 'canopen.eds="drives/mine.dcf"')
    options = {option.what: option.text for option in result.options}
    assert options["connection_lost"] == "quick stop"
    dcf.write_text(f"{own}\n[DeviceComissioning]\nNodeID=0x7\n", encoding="utf-8")
    assert "is the DCF of node 7; drive.node_id is 5" in asked(
        configs, channel, 'canopen.eds="drives/mine.dcf"'
    )


def test_a_silent_node_is_named_with_those_that_are_heard(configs: Path, channel: str) -> None:
    with emulated(configs, channel):
        said = refused_untouched(configs, channel, "drive.node_id=9", "canopen.answer_timeout_s=0.05")
    assert "node 9 does not answer on hil-local" in said and "heard on this bus: node 5" in said


def test_two_nodes_with_one_number(configs: Path, channel: str) -> None:
    with emulated(configs, channel), stranger(channel):
        said = refused_untouched(configs, channel)
    assert "two nodes answer as node 5" in said


def test_another_device_than_the_eds(configs: Path, channel: str) -> None:
    with stranger(channel) as node:
        node.sdo[0x1018][2].raw = 0x403
        assert "is of product 0x402, node 5 is 0x403" in refused_untouched(configs, channel)


def test_another_controller_is_not_disturbed(configs: Path, channel: str) -> None:
    with emulated(configs, channel), can.Bus(channel, "hil-local") as bus:
        sync = can.Message(arbitration_id=0x80, data=[], is_extended_id=False)
        task = bus.send_periodic(sync, 0.005)
        said = refused_untouched(configs, channel)
        task.stop()
    assert "another controller sends 0x80" in said


def test_an_enabled_drive_is_left_alone(configs: Path, channel: str) -> None:
    with stranger(channel) as node:
        node.sdo[0x6041].raw = 0x0237
        assert "node 5 is enabled (6041h = 0x0237)" in refused_untouched(configs, channel)


def test_a_drive_that_stands_in_fault_is_told_before_it_is_armed(
    configs: Path, channel: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """`hil check` fails, `hil run` says that arming resets it."""
    with stranger(channel) as node:
        node.sdo[0x6061].raw = 10
        set_up(configs, channel)
        node.sdo[0x6041].raw, node.sdo[0x603F].raw = 0x0218, 0x3210
        assert compare(job(configs, channel)).fault == 0x3210
        setup = load_setup(run_config(configs), Overrides(channel=channel))
        (row,) = canopen_rows(setup)
        check_set_up(setup)
    assert row.verdict == "fail" and row.found.endswith(
        "it stands in fault, error 0x3210, DC link over-voltage"
    )
    assert (
        "the drive stands in fault, error 0x3210, DC link over-voltage: arming resets it"
        in capsys.readouterr().err
    )


def test_a_drive_without_the_mode(configs: Path, channel: str) -> None:
    with stranger(channel) as node:
        node.sdo[0x6502].raw = 0x180
        said = refused_untouched(configs, channel)
    assert "has no mode cst (6502h = 0x180): it has csp, csv" in said


def test_a_mode_that_is_not_confirmed(configs: Path, channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.canopen_node.SHOWS_MODE_S", 0.05)
    with stranger(channel) as node:
        node.sdo[0x6061].raw = 8
        said = asked(configs, channel)
        assert node.nmt.state == "PRE-OPERATIONAL"
    assert "does not confirm mode cst: 6061h shows 8 (csp), not 10" in said


Callback = Callable[..., Any]


def refusing(index: int, sub: int, code: int) -> Callback:
    def check(index_: int = 0, subindex: int = 0, **_: object) -> None:
        if (index_, subindex) == (index, sub):
            raise SdoAbortedError(code)

    return lambda index, subindex, od, data: check(index_=index, subindex=subindex)


@pytest.mark.parametrize(
    ("index", "sub", "code", "said"),
    [
        (0x1A00, 2, 0x06040041, "1A00h:2 can't be set to 0x606C0020: abort 0x06040041, Object cannot be m"),
        (0x1A00, 0, 0x06010002, "1A00h can't be set to 0: abort 0x06010002, Attempt to write a read only"),
        (0x1400, 1, 0x08000022, "1400h:1 can't be set to 0x80000205: abort 0x08000022, Data can not be"),
        (0x6060, 0, 0x06090030, "6060h can't be set to 10: abort 0x06090030, Value range of parameter"),
        (0x60C2, 2, 0x0604FFFF, "60C2h:2 can't be set to -3: abort 0x0604FFFF, a code of the maker"),
    ],
)  # fmt: skip
def test_a_refusal_is_told_with_object_and_text(
    configs: Path, channel: str, index: int, sub: int, code: int, said: str
) -> None:
    with stranger(channel) as node:
        node.add_write_callback(refusing(index, sub, code))
        heard = asked(configs, channel)
    assert said in heard and "node 5 on hil-local" in heard and "\n" not in heard


def test_what_a_node_takes_and_does_not_hold(configs: Path, channel: str) -> None:
    """A maker's node that answers each write with yes, and has a mapping of its own."""
    with stranger(channel) as node:
        node.add_read_callback(
            lambda index, subindex, od: 0x60640020 if (index, subindex) == (0x1A00, 2) else None
        )
        node.sdo[0x6061].raw = 10
        said = asked(configs, channel)
    assert "took it and holds another value: 1A00h:2 is 0x60640020, not 0x606c0020" in said


def test_command_line(
    configs: Path, channel: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, dbc = str(run_config(configs)), str(configs / "drives" / "cia402.dbc")
    with emulated(configs, channel):
        Path(dbc).unlink()
        assert main(["configure", config, "-c", channel, "--check", "--json"]) == 1
        before = json.loads(capsys.readouterr().out)
        assert main(["configure", config, "-c", channel, "--dbc", dbc, "--store", "--json"]) == 0
        after = json.loads(capsys.readouterr().out)
        assert main(["configure", config, "-c", channel, "--check"]) == 0
        table = capsys.readouterr().out
    assert (
        not before["ok"] and not before["written"] and any("no such DBC yet" in p for p in before["problems"])
    )
    assert (
        after["ok"] and after["written"] and after["stored"] and after["dbc"] == dbc and after["node"] == NODE
    )
    assert after["options"]["quick_stop"] == {"object": "605Ah", "code": 0, "text": "voltage off"}
    assert "6041h Statusword" in table and "connection_lost (6007h)" in table
    assert main(["configure", config, "--check", "--store"]) == 2
    assert main(["configure", str(configs / "demo.toml")]) == 2
    assert "canopen: missing; add [canopen]" in capsys.readouterr().err
    assert main(["configure", config, "-c", channel, "--dbc", str(tmp_path / "x.txt")]) == 2


def test_a_dbc_that_says_else_than_the_drive(configs: Path, channel: str) -> None:
    """Another rated torque in the drive: the DBC of a run would scale every torque wrongly."""
    made, dbc = job(configs, channel), configs / "drives" / "cia402.dbc"
    with emulated(configs, channel):
        set_up(configs, channel)
        dbc.write_text(dbc.read_text(encoding="utf-8").replace("0.01368", "0.02"), encoding="utf-8")
        problems = compare(made).problems
    assert len(problems) == 2 and all("0.01368 Nm" in p and "0.02 Nm" in p for p in problems)
    assert EDS.exists()


@pytest.mark.parametrize(("i_max", "fits"), [(10.0, True), (15.0, False)])
def test_a_torque_that_the_drive_cuts_off(configs: Path, channel: str, i_max: float, fits: bool) -> None:
    """6072h lets 3 x 13.68 = 41.04 N m through; 15 A by 3.6 N m/A are 54 N m."""
    with emulated(configs, channel):
        set_up(configs, channel)
        problems = compare(job(configs, channel, f"limits.i_max_a={i_max}")).problems
    said = "limits.i_max_a asks for up to 54 N m, the drive cuts off at 41.04 N m (6072h)"
    assert problems == [] if fits else len(problems) == 1 and problems[0].startswith(said)
