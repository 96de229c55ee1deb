"""A limit that the drive's frames can't show to be passed is refused, with one line for each."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.errors import ConfigError
from hil.runtime.setup import Overrides, load_setup


def refused(path: Path, *settings: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load_setup(path, Overrides(settings=settings))
    return caught.value.problems


def test_the_shipped_limits_can_be_shown(configs: Path) -> None:
    for name in ("demo", "vcan0", "can0", "paper", "inverter"):
        load_setup(configs / f"{name}.toml", Overrides())


@pytest.mark.parametrize(
    ("limit", "value", "part", "top"),
    [
        ("i_trip_a", "22", "i_d", "20.47"),
        ("i_trip_a", "20.47", "i_d", "20.47"),
        ("w_max_rad_s", "400", "speed", "327.67"),
        ("i_d_max_a", "30", "i_d", "20.47"),
        ("v_dc_max_v", "7000", "v_dc", "6553.5"),
    ],
)
def test_a_limit_beyond_the_frame_is_refused(
    configs: Path, limit: str, value: str, part: str, top: str
) -> None:
    lines = refused(configs / "demo.toml", f"limits.{limit}={float(value)}")
    assert lines == [f"limits.{limit}: {part} shows no more than {top}; {value} would never trip, take less"]


@pytest.mark.parametrize(
    ("name", "limit", "value", "top"),
    [
        ("demo", "u_max_v", 328.0, "327.67"),
        ("inverter", "u_max_v", 401.0, "400"),
        ("paper", "T_L_max_n_m", 3000.0, "2147"),
    ],
)
def test_a_limit_that_no_command_carries_is_refused(
    configs: Path, name: str, limit: str, value: float, top: str
) -> None:
    lines = refused(configs / f"{name}.toml", f"limits.{limit}={value}")
    assert lines == [f"limits.{limit}: a command carries no more than {top}; take less, or correct the DBC"]


def test_just_below_the_frames_end_is_taken(configs: Path) -> None:
    load_setup(configs / "demo.toml", Overrides(settings=("limits.i_trip_a=20.46",)))


def test_all_are_named_at_once(configs: Path) -> None:
    lines = refused(configs / "demo.toml", "limits.i_trip_a=40.0", "limits.temperature_max_c=300.0")
    assert [line.split(":")[0] for line in lines] == [
        "limits.i_trip_a", "limits.i_trip_a", "limits.temperature_max_c", "limits.temperature_max_c"
    ]  # fmt: skip


def test_a_limit_on_what_the_drive_does_not_send_is_refused(configs: Path) -> None:
    path = configs / "inverter.toml"
    path.write_text(path.read_text().replace('v_dc = "Supply.Udc"\n', ""))
    lines = refused(path)
    assert lines == [
        f"limits.v_dc_{end}_v: the drive has no v_dc to judge by; map it or remove the limit"
        for end in ("min", "max")
    ]
    text = path.read_text().replace("v_dc_min_v = 450.0\n", "").replace("v_dc_max_v = 650.0\n", "")
    path.write_text(text)
    load_setup(path, Overrides())


def test_one_temperature_is_enough_to_judge_by(configs: Path) -> None:
    path = configs / "inverter.toml"
    text = path.read_text().replace('temperature_motor = "Supply.MotorTemperature"\n', "")
    path.write_text(text)
    load_setup(path, Overrides())
    path.write_text(text.replace('temperature_inverter = "Supply.InverterTemperature"\n', ""))
    assert "no temperature_motor or temperature_inverter" in refused(path)[0]
