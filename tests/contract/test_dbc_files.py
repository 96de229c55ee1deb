"""DBC files as other people and tools write them: what is right, what is odd where nobody looks, how fast."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest

from drivers.binding import bind
from drivers.client import DriveClient
from drivers.codec import Database
from drivers.errors import DatabaseError, EncodeError
from drivers.mapping import house_map
from drivers.units import ANGLE, CELSIUS, CURRENT, SPEED, TORQUE, VOLTAGE, unit_of
from hil.runtime.setup import Overrides, load_setup
from hil.signals import new_ticks
from tests.conftest import CONFIGS
from tests.contract.test_map_bits import Broken, database, other, refusal

HOUSE = CONFIGS / "drives/hil_pmsm.dbc"
RPM = 'SG_ Rpm : 7|16@0- (0.5,0) [-16000|16000] "rpm"'


def rpm(unit: str) -> tuple[str, str]:
    return RPM, RPM.replace('"rpm"', f'"{unit}"')


@pytest.mark.parametrize(
    ("text", "units", "factor"),
    [
        *((unit, SPEED, math.pi / 30) for unit in ("rpm", "RPM", "r/min", "rev/min", "min-1", "min⁻¹")),
        *((unit, SPEED, math.pi / 30) for unit in ("min^-1", "1/min", "1/min ", "speed:rpm", "[rpm]")),
        *((unit, SPEED, 2 * math.pi) for unit in ("rev/s", "r/s", "rps", "turns/s")),
        *((unit, SPEED, 1.0) for unit in ("rad/s", "Rad/s", "rad·s⁻¹", "rad s^-1")),
        ("deg/s", SPEED, math.pi / 180), ("°/s", SPEED, math.pi / 180),
        ("A", CURRENT, 1.0), ("Amps", CURRENT, 1.0), ("A pk", CURRENT, 1.0), ("mA", CURRENT, 1e-3),
        ("Arms", CURRENT, math.sqrt(2)), ("A rms", CURRENT, math.sqrt(2)), ("A_rms", CURRENT, math.sqrt(2)),
        ("V", VOLTAGE, 1.0), ("Volts", VOLTAGE, 1.0), ("mV", VOLTAGE, 1e-3), ("kV", VOLTAGE, 1e3),
        *((unit, CELSIUS, 1.0) for unit in ("degC", "deg C", "°C", "Â°C", "ºC", "℃", "C", "Celsius")),
        *((unit, TORQUE, 1.0) for unit in ("N m", "Nm", "N*m", "N·m", "N-m", "NM")), ("mNm", TORQUE, 1e-3),
        ("1/4096 rev", ANGLE, 2 * math.pi / 4096), ("1/10000 rev", ANGLE, 2 * math.pi / 10_000),
    ],
)  # fmt: skip
def test_units_as_people_write_them(text: str, units: Any, factor: float) -> None:
    found = unit_of(text, units)
    assert found is not None and found.factor == factor and not found.electrical


@pytest.mark.parametrize(
    ("text", "units"),
    [("", SPEED), ("Hz", SPEED), ("1/s", SPEED), ("MA", CURRENT), ("MV", VOLTAGE), ("MNm", TORQUE),
     ("K", CELSIUS), ("%", CURRENT), ("Vrms", VOLTAGE),
     ("counts", ANGLE), ("inc", ANGLE), ("1/0 rev", ANGLE), ("1/4096", ANGLE)],
)  # fmt: skip
def test_units_that_could_be_two_are_none(text: str, units: Any) -> None:
    assert unit_of(text, units) is None


def test_electrical_speed_needs_the_pole_pairs(tmp_path: Path) -> None:
    base = database(tmp_path, rpm("ERPM"))
    assert "speed: MotorSpeed.Rpm counts electrical turns" in refusal(base, other())
    speed = bind(other(pole_pairs=7), base).signal("speed")
    assert speed and speed.scale == pytest.approx(0.5 * math.pi / 30 / 7)


def test_a_config_gives_a_unit_and_the_motors_pole_pairs(configs: Path) -> None:
    path, dbc = configs / "inverter.toml", configs / "drives/inverter_fd.dbc"
    dbc.write_text(dbc.read_text().replace('"rpm"', '"counts"'))
    with pytest.raises(
        DatabaseError, match=r"unit 'counts'; give it one of rad/s, .* in drive\.signals\.units"
    ):
        load_setup(path, Overrides())
    given = "[drive.signals.constants]"
    path.write_text(path.read_text().replace(given, f'[drive.signals.units]\nspeed = "erpm"\n\n{given}'))
    speed = load_setup(path, Overrides()).binding.signal("speed")
    assert speed and speed.scale == pytest.approx(0.01 * math.pi / 30 / 3) and speed.unit == "rad/s"


@pytest.mark.parametrize(
    ("units", "told"),
    [
        ({"speed": "furlong"}, "speed: MotorSpeed.Rpm is given the unit 'furlong'"),
        ({"sped": "rpm"}, "units: sped is no part of this map"),
        (
            {"MotorSpeed.Mode": "rpm", "MotorSpeed.Spin": "rpm"},
            "units: MotorSpeed.Spin is no part of this map",
        ),
    ],
)
def test_a_unit_must_be_known_and_given_to_something(
    tmp_path: Path, units: dict[str, str], told: str
) -> None:
    assert told in refusal(database(tmp_path), other(units=units))


def test_a_units_word_counts_above_the_dbcs(tmp_path: Path) -> None:
    speed = bind(other(units={"MotorSpeed.Rpm": "rev/s"}), database(tmp_path)).signal("speed")
    assert speed and speed.scale == pytest.approx(0.5 * 2 * math.pi)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16", "latin-1"])
def test_the_encoding_is_found_out(tmp_path: Path, encoding: str) -> None:
    text = HOUSE.read_text().replace('"degC"', '"°C"').replace("Mechanical speed.", "Speed of the rotor, µ")
    path = tmp_path / "text.dbc"
    path.write_bytes(text.encode(encoding))
    base = Database(path)
    assert base.message("STATUS").signals["TemperatureMotor"].unit == "°C"
    bind(house_map(base), base)


def test_quotes_and_line_ends_of_other_editors(tmp_path: Path) -> None:
    text = HOUSE.read_text().replace("Mechanical speed.", "the “rotor’s” // BO_ 5 speed:\nBO_ 6 X: 8 Y\n SG_ not one").replace("\n", "\r\n")  # fmt: skip # noqa: E501
    path = tmp_path / "quotes.dbc"
    path.write_bytes(text.encode("cp1252"))
    base = Database(path)
    assert list(base.messages) == list(Database(HOUSE).messages)
    bind(house_map(base), base)


ODD = {
    "overlap": 'BO_ 900 Odd: 8 Drive\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\n SG_ B : 4|8@1+ (1,0) [0|1] "" X\n',
    "does not fit": 'BO_ 900 Odd: 2 Drive\n SG_ A : 8|16@1+ (1,0) [0|1] "" X\n',
    "29 bits": 'BO_ 419361024 Odd: 8 Drive\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\n',
    "a name twice": "BO_ 900 Odd: 8 Drive\n\nBO_ 901 Odd: 8 Drive\n",
    "an identifier twice": "BO_ 900 Odd: 8 Drive\n\nBO_ 900 Other: 8 Drive\n",
    "no length": "BO_ 900 Odd: 10 Drive\n",
    "no grammar": "BO_ 900 Odd: 8 Drive\n SG_ A : 0-8 (1,0) nonsense\n",
    "a value table of nobody": 'VAL_ 513 Nobody 1 "one" ;\n',
    "a value table of no message": 'VAL_ 999 Nobody 1 "one" ;\n',
    "a type of nobody": "SIG_VALTYPE_ 513 Nobody : 1;\n",
    "attributes of other types": 'BA_DEF_ BO_ "GenMsgX" HEX 0 1;\nBA_ "GenMsgX" BO_ 900 zero;\n',
    "an attribute of a node": 'BA_ "Unknown" BU_ Drive 1;\n',
    "a broken comment": 'CM_ SG_ 513 "no signal";\n',
    "signals of no frame": "BO_ 3221225472 VECTOR__INDEPENDENT_SIG_MSG: 0 X\n SG_ A : 0|8@1+ (1,0)\n",
}  # fmt: skip


@pytest.mark.parametrize("name", ODD)
def test_only_what_is_mapped_can_be_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "odd.dbc"
    text = HOUSE.read_text()
    path.write_text(text.replace('CM_ "Drive protocol', ODD[name] + '\nCM_ "Drive protocol'))
    base = Database(path)
    bind(house_map(base), base)
    if "Odd" in ODD[name] and name != "overlap" and name != "does not fit":
        with pytest.raises(DatabaseError, match="Odd"):
            base.message("Odd")


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (("BO_ 2566852610 Supply", "BO_ 419368962 Supply"), "has more than 11 bits .* write 2566852610"),
        (("SG_ Udc : 7|16@0+", "SG_ Udc : 15|16@0+"), r"Supply\.Udc does not fit into 2 bytes"),
        (("SG_ Udc : 7|16@0+ (0.1,0)", "SG_ Udc : 7|16@0+ (0,0)"), r"Supply\.Udc: scale 0"),
        (("BO_ 2566852610 Supply: 2", "BO_ 2566852610 Supply: 9"), "no CAN frame has 9 bytes"),
        (("BO_ 2566852610 Supply", "BO_ 2566852609 Supply"), "identifier 0x18FF1001 is that of MotorC"),
    ],
)  # fmt: skip
def test_what_is_mapped_is_refused_with_its_reason(tmp_path: Path, edit: tuple[str, str], told: str) -> None:
    with pytest.raises(DatabaseError, match=told):
        bind(other(), database(tmp_path, edit))


@pytest.mark.parametrize("profile", ["2", '"2"', '"P02"', '"Profile 2"', '"E2E_P02"', "2.0"])
def test_a_profile_is_a_number_or_a_word(tmp_path: Path, profile: str) -> None:
    text = HOUSE.read_text().replace('"E2EProfile" INT 0 5', '"E2EProfile" STRING ')
    path = tmp_path / "profile.dbc"
    path.write_text(text.replace('BA_ "E2EProfile" BO_ 513 2;', f'BA_ "E2EProfile" BO_ 513 {profile};'))
    assert Database(path).message("COMMAND").profile == 2


@pytest.mark.parametrize(
    ("profile", "told"), [('"P01A"', "E2EProfile P01A is not one of 0, 2, 5"), ("7", "7 is not")]
)
def test_a_profile_that_nobody_can_compute_is_refused(tmp_path: Path, profile: str, told: str) -> None:
    path = tmp_path / "profile.dbc"
    path.write_text(
        HOUSE.read_text().replace('BA_ "E2EProfile" BO_ 513 2;', f'BA_ "E2EProfile" BO_ 513 {profile};')
    )
    with pytest.raises(DatabaseError, match=told):
        Database(path).message("COMMAND")


def test_a_profile_of_an_enumeration(tmp_path: Path) -> None:
    text = HOUSE.read_text().replace(
        '"E2EProfile" INT 0 5', '"E2EProfile" ENUM "NONE","Profile 5","Profile 2"'
    )
    path = tmp_path / "profile.dbc"
    path.write_text(text.replace('BA_DEF_DEF_  "E2EProfile" 0', 'BA_DEF_DEF_  "E2EProfile" "NONE"'))
    base = Database(path)
    assert (base.message("COMMAND").profile, base.message("SYNC").profile) == (2, 0)


@pytest.mark.parametrize(
    ("value", "cycle"), [("0", 0.0), ("5", 5.0), ("2.5", 2.5), ('"5"', 5.0), ('"fast"', 0.0), ("-1", 0.0)]
)
def test_cycle_times_as_others_write_them(tmp_path: Path, value: str, cycle: float) -> None:
    edit = ("BO_ 2566852608 5;", f"BO_ 2566852608 {value};")
    base = database(tmp_path, edit)
    assert base.message("MotorSpeed").cycle_ms == cycle
    bind(other(), base, period_ms=5.0)


def test_names_of_more_than_32_characters(tmp_path: Path) -> None:
    long, signal = "TheSpeedOfTheRotorOfTheMotorOfTheDrive", "MechanicalSpeedOfTheRotorInTurnsPerMinute"
    more = (
        'BA_DEF_ BO_ "SystemMessageLongSymbol" STRING ;\nBA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;\n'
        'BA_DEF_DEF_ "SystemMessageLongSymbol" "";\nBA_DEF_DEF_ "SystemSignalLongSymbol" "";\n'
        f'BA_ "SystemMessageLongSymbol" BO_ 2566852608 "{long}";\n'
        f'BA_ "SystemSignalLongSymbol" SG_ 2566852608 Rpm "{signal}";\n'
    )
    base = database(tmp_path, more=more)
    drive = other(speed=f"{long}.{signal}", state=f"{long}.Mode", counters=(f"{long}.Alive", "Demand.Alive"))
    speed = bind(drive, base).signal("speed")
    assert speed and speed.name == signal
    plain = "A" * 40
    base = database(tmp_path, ("MotorSpeed:", f"{plain}:"), ("SG_ Rpm", f"SG_ {plain}"))
    assert bind(other(speed=f"{plain}.{plain}", state=f"{plain}.Mode", counters=("Demand.Alive",)), base)


@pytest.mark.parametrize("constant", [1e39, -1e39, 3.5e38])
def test_a_number_beyond_32_bits_is_never_infinity(tmp_path: Path, constant: float) -> None:
    base = database(
        tmp_path,
        ("SG_ Key : 63|8@0+ (1,0) [0|255]", "SG_ Key : 71|32@0- (1,0) [0|0]"),
        ("SG_ Alive : 71|4@0+ (1,0)", "SG_ Alive : 63|4@0+ (1,0)"),
        more="SIG_VALTYPE_ 2566852864 Key : 1;\n",
    )
    assert "overflows a float of 32 bits" in refusal(base, other(constants={"Demand.Key": constant}))
    with pytest.raises(EncodeError, match="overflows"):
        base.message("Demand").encode({"Key": constant})


def test_a_voltage_that_is_a_float_has_a_step_and_an_end(tmp_path: Path) -> None:
    base = database(
        tmp_path,
        ("SG_ Uq : 7|24@0- (0.0001,0) [-400|400]", "SG_ Uq : 7|32@0- (1,0) [-1e39|1e39]"),
        ("SG_ Ud : 31|24@0- (0.0001,0) [-400|400]", "SG_ Ud : 95|32@0- (1,0) [-500|500]"),
        ("Demand: 12 Ecu", "Demand: 16 Ecu"),
        more="SIG_VALTYPE_ 2566852864 Uq : 1;\nSIG_VALTYPE_ 2566852864 Ud : 1;\n",
    )
    binding = bind(other(), base)
    u_q = binding.signal("u_q")
    assert u_q and u_q.top == pytest.approx(3.4028235e38)
    assert (binding.u_step, binding.u_top) == (2.0**-10, 500.0)
    client = DriveClient(Broken([]), base, drive_map=other())
    tick: Any = new_ticks()[0]
    for controlword, u in ((0x06, 0.0), (0x0F, -12.25 - 2.0**-10)):
        tick["controlword"], tick["u_q"] = controlword, u
        client.send(tick)
    short = ("SG_ Uq : 7|24@0- (0.0001,0) [-400|400]", "SG_ Uq : 7|16@0- (1,0) [-400|400]")
    half = database(tmp_path, short, more="SIG_VALTYPE_ 2566852864 Uq : 1;\n")
    assert "u_q: Demand.Uq is a float of 16 bits, which can be received only" in refusal(half, other())


@pytest.mark.parametrize(
    ("node_id", "rule", "can_id", "extended", "moved"),
    [
        (2, "", 0x181, False, 0x182),
        (2, "", 0x701, False, 0x702),
        (2, "", 0x081, False, 0x082),
        (2, "", 0x080, False, 0x080),
        (2, "", 0x007, False, 0x007),
        (2, "", 0x182, False, 0x182),
        (2, "", 0x181, True, 0x181),
        (3, "id << 5", 0x009, False, 0x069),
        (3, "id<<5", 0x029, False, 0x069),
        (0, "id << 5", 0x02C, False, 0x00C),
        (9, "id << 0 : 8", 0x904, True, 0x909),
    ],
)
def test_where_a_nodes_number_goes(
    tmp_path: Path, node_id: int, rule: str, can_id: int, extended: bool, moved: int
) -> None:
    path = tmp_path / "node.dbc"
    path.write_text(f'BO_ {can_id | extended << 31} M: 1 X\n SG_ A : 0|8@1+ (1,0) [0|1] "" Y\n')
    assert Database(path, node_id, rule).message("M").can_id == moved


def test_a_number_that_moves_nothing_is_refused(tmp_path: Path) -> None:
    text = HOUSE.read_text().replace("BO_ 385 FEEDBACK", "BO_ 7 FEEDBACK").replace(" 385 ", " 7 ")
    path = tmp_path / "node.dbc"
    path.write_text(text)
    bind(house_map(Database(path)), Database(path))
    told = refusal(Database(path, 3), house_map(Database(path, 3)))
    assert "FEEDBACK has the identifier 0x7, which node_id = 3 does not move" in told and "node_rule" in told
    bind(house_map(Database(HOUSE, 3)), Database(HOUSE, 3))


@pytest.mark.parametrize(
    ("node_id", "rule", "told"),
    [
        (3, "id + 5", 'node_rule = "id \\+ 5": write "id << 5"'),
        (0, "", "node_id = 0: CANopen has the nodes 1 to 127"),
        (128, "", "node_id = 128: CANopen has"),
        (64, "id << 5", "64 does not fit into identifier"),
    ],
)
def test_a_rule_that_is_none(node_id: int, rule: str, told: str) -> None:
    with pytest.raises(DatabaseError, match=told):
        Database(HOUSE, node_id, rule).message("FEEDBACK")


def test_two_messages_that_meet_after_moving_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "meet.dbc"
    path.write_text(HOUSE.read_text())
    told = refusal(Database(path, 2, "id << 8 : 3"), house_map(Database(path, 2, "id << 8 : 3")))
    assert "both have the identifier" in told


def test_a_file_of_35000_messages_takes_no_longer_than_its_text(tmp_path: Path) -> None:
    lines = "".join(
        f'BO_ {0x80000000 + 7 * i + 1} M{i}: 8 X\n SG_ S : 0|8@1+ (1,0) [0|255] "" Y\n\n'
        for i in range(35_000)
    )
    path = tmp_path / "large.dbc"
    path.write_text(HOUSE.read_text().replace('CM_ "Drive protocol', lines + 'CM_ "Drive protocol'))
    begin = time.process_time()
    base = Database(path)
    bind(house_map(base), base)
    assert base.of_frame(0x80000000 + 7 * 34_999 + 1) is base.message("M34999")
    assert time.process_time() - begin < 30.0, "hours when each message was compared with each"


def test_a_wrong_name_in_a_large_file_is_told_in_a_few_words(tmp_path: Path) -> None:
    path = tmp_path / "large.dbc"
    path.write_text("".join(f"BO_ {i} M{i}: 8 X\n\n" for i in range(1000)))
    with pytest.raises(DatabaseError, match=r"has no message N; it has M0, M1, .* and 970 more") as caught:
        Database(path).message("N")
    assert len(str(caught.value)) < 500
