"""A configuration with mistakes is refused, all of them named at once, with what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.config import MAX_CONFIG_BYTES, RunConfig, load_toml
from hil.errors import ConfigError


def problems(path: Path, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_toml(path, RunConfig, overrides)
    return str(caught.value)


def test_the_shipped_configurations_load(configs: Path) -> None:
    shipped = [p for p in configs.glob("*.toml") if p.name != "faults.toml"]
    assert shipped
    for path in shipped:
        load_toml(path, RunConfig)


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
