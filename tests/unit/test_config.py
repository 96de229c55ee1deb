"""A configuration with mistakes is refused, all of them named at once, with what to do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from firmware_model.config import PlantConfig
from hil.config.mistakes import _tags, models_in
from hil.config.nodefile import load_nodes
from hil.config.tables import RunConfig, load_toml
from hil.config.toml import MAX_CONFIG_BYTES
from hil.errors import ConfigError
from tests.conftest import ROOT


def problems(path: Path, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_toml(path, RunConfig, overrides)
    return str(caught.value)


def test_the_shipped_configurations_load(configs: Path) -> None:
    shipped = [p for p in configs.glob("*.toml") if p.name != "faults.toml"]
    assert shipped
    for path in shipped:
        assert load_nodes(path) or load_toml(path, RunConfig)


def test_unknown_key_gets_a_suggestion(configs: Path) -> None:
    text = problems(configs / "demo.toml", "loop.rate_hzz=1000")
    assert text.endswith("demo.toml: loop.rate_hzz: unknown key; did you mean 'rate_hz'?")


def test_all_mistakes_are_named_at_once(configs: Path) -> None:
    text = problems(
        configs / "demo.toml", "loop.rate_hz='fast'", "limits.foo=1", "motor.J_kg_m2=-1", "reference.w_rad=3"
    )
    assert len(text.splitlines()) == 4
    for key in ("loop.rate_hz", "limits.foo", "motor.J_kg_m2", "reference.s-curve.w_rad"):
        assert key in text


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("loop.rate_hz=999", "no whole number of nanoseconds"),
        ("limits.i_trip_a=1.0", "i_trip_a must be above i_max_a"),
        ("limits.w_max_rad_s=nan", "finite"),
        ("limits.u_max_v=inf", "finite"),
        ("limits.v_dc_max_v=1.0", "v_dc_max_v must be above"),
        ("observer.speed.kind='luenberger'", "'exponentials', 'ftdob'"),
        ("reference.kind='triangle'", "reference"),
        ("loop.pacing='sometimes'", "'sync', 'feedback' or 'timer'"),
        ("motor='motors/none.toml'", "can't be read"),
    ],
)
def test_values_out_of_bounds(configs: Path, override: str, said: str) -> None:
    assert said in problems(configs / "demo.toml", override)


@pytest.mark.parametrize("key", ["w_max_rad_s", "i_max_a", "i_trip_a", "u_max_v", "du_max_v"])
def test_a_config_without_limits_is_refused(configs: Path, tmp_path: Path, key: str) -> None:
    text = (configs / "demo.toml").read_text()
    path = tmp_path / "c.toml"
    path.write_text("\n".join(line for line in text.splitlines() if not line.startswith(key)))
    assert f"limits.{key}: missing; add it" in problems(path)


def test_a_motor_may_stand_in_its_own_file(configs: Path) -> None:
    config = load_toml(configs / "demo.toml", RunConfig, ['motor="motors/bench.toml"'])
    assert config.motor.name == "bench"


def test_nonsense_files(tmp_path: Path) -> None:
    missing, broken, huge = tmp_path / "no.toml", tmp_path / "b.toml", tmp_path / "h.toml"
    broken.write_bytes(b"[loop\nrate = ")
    huge.write_bytes(b"#" * (MAX_CONFIG_BYTES + 1))
    assert "can't be read" in problems(missing)
    assert "is not TOML" in problems(broken)
    assert "no configuration" in problems(huge)
    broken.write_bytes(b"\xff\xfe\x00")
    assert "is not TOML" in problems(broken)


@pytest.mark.parametrize("override", ["novalue", "=3", "loop.rate_hz.deeper=3"])
def test_malformed_overrides(configs: Path, override: str) -> None:
    assert "--set" in problems(configs / "demo.toml", override)


def test_tables_must_increase(configs: Path, tmp_path: Path) -> None:
    text = (configs / "demo.toml").read_text()
    start, end = text.index("[reference]"), text.index("[log]")
    path = tmp_path / "c.toml"
    path.write_text(
        text[:start] + '[reference]\nkind="table"\nt_s=[0.0,0.0]\nw_rad_s=[0.0,1.0]\n' + text[end:]
    )
    assert "t_s must increase" in problems(path)


def numbers(model: type[BaseModel], given: dict[str, Any], path: str = "") -> Iterator[str]:
    """Every number of a configuration's tables as ``table.key``; of tables of several kinds the given one."""
    for name, field in model.model_fields.items():
        if isinstance(given.get(name), list):
            continue
        inner = [m for m in models_in(field.annotation) if "kind" not in m.model_fields]
        inner += [m for m in models_in(field.annotation) if (given.get(name) or {}).get("kind") in _tags(m)]
        for one in inner[:1]:
            yield from numbers(one, given.get(name) or {}, f"{path}{name}.")
        if not inner and any(kind in repr(field.annotation) for kind in ("int", "float")):
            yield path + name


def config_numbers() -> list[str]:
    given = RunConfig.model_validate(
        load_toml(ROOT / "configs/demo.toml", RunConfig).model_dump()
    ).model_dump()
    return [
        name for name in numbers(RunConfig, given) if name not in ("drive.signals", "observer.speed.kind")
    ]


@pytest.mark.parametrize("text", ["1e23", "1e300", "1" + 400 * "0", "-1e23", "-1e300", "nan", "inf"])
def test_no_number_is_beyond_every_range(configs: Path, text: str) -> None:
    keys = config_numbers()
    assert len(keys) > 60 and {"limits.w_max_rad_s", "guardian.timeout_ms", "reference.w_rad_s"} <= set(keys)
    for key in keys:
        found = problems(configs / "demo.toml", f"{key}={text}")
        assert key.rpartition(".")[2] in found and len(found) < 600, key


@pytest.mark.parametrize("text", ["1e23", "1e300", "1" + 400 * "0", "-1e23", "nan", "inf"])
def test_no_number_of_a_plant_is_beyond_every_range(configs: Path, text: str) -> None:
    given = load_toml(configs / "plants/demo.toml", PlantConfig).model_dump()
    keys = list(numbers(PlantConfig, given))
    assert len(keys) > 20
    loads = ["[{kind='constant', torque_n_m=%s}]", "[{kind='step', torque_n_m=1.0, at_s=%s}]"]
    faults = ["[{kind='load', at_s=%s, torque_n_m=1.0}]", "[{kind='delay', at_s=0.5, delay_ms=%s}]"]
    settings = [f"{key}={text}" for key in keys] + [f"load={one % text}" for one in loads]
    for setting in [*settings, *(f"fault={one % text}" for one in faults)]:
        with pytest.raises(ConfigError):
            load_toml(configs / "plants/demo.toml", PlantConfig, [setting])


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("loop.feedback_timeout_us=100001", "less than or equal to 100000"),
        ("loop.feedback_timeout_us=20001", "longer than max_gap_ticks periods"),
        ("guardian.timeout_ms=10001", "less than or equal to 10000"),
        ("guardian.timeout_ms=1e300", "less than or equal to 10000"),
        ("motor.J_kg_m2=5e-324", "greater than or equal to"),
    ],
)
def test_ranges_of_times(configs: Path, override: str, said: str) -> None:
    assert said in problems(configs / "demo.toml", override)


def test_a_mistake_of_a_whole_file_has_no_key(configs: Path) -> None:
    loads = "load=" + repr([{"kind": "constant", "torque_n_m": 1.0}] * 8).replace(
        "'kind':", "kind ="
    ).replace("'torque_n_m':", "torque_n_m =")
    extra = "fault=[{kind='load', at_s=0.5, torque_n_m=1.0}]"
    with pytest.raises(ConfigError, match="more than 8 loads with those of the faults"):
        load_toml(configs / "plants/demo.toml", PlantConfig, [loads, extra])
