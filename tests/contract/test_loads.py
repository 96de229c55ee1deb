"""Every load of the registry: its kernels agree with one another and with DOP853, its keys are its row's.

A load of an outside package (the one that docs/extend.md shows) is what those of the house are.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from drivers import kernelcache
from firmware_model import drive
from firmware_model.config import PlantConfig, Wire, build_params, new_state
from firmware_model.load import edge_after, load_torque
from firmware_model.loads import brake, constant, sine
from firmware_model.plant import ANGLE, LOAD, PARAMETERS, PARAMS, State
from firmware_model.registry import Load, PlantError, _checked, loads
from firmware_model.series import ORDER, evaluate, integral
from firmware_model.tables import Finite, Table
from hil.manual.keys import found, tables
from tests.conftest import CONFIGS, ROOT

WIRE = Wire(0.01, 327.67, 0.001, 32.767, 0.01, 20.47)
MOTOR = {
    "R_s_ohm": 2.0, "L_d_h": 0.02, "L_q_h": 0.033, "psi_f_wb": 0.7, "n_p": 3, "J_kg_m2": 0.011
}  # fmt: skip
FREE = {"i_trip_a": 1e3, "w_trip_rad_s": 1e4, "temperature_trip_c": 1e3}
KINDS = sorted(loads())
VARYING = [kind for kind in KINDS if loads()[kind].coefficient]
TURNED = [kind for kind in KINDS if loads()[kind].turned]
HELD = [kind for kind in KINDS if kind not in VARYING + TURNED]
ENDS = {"at_s": 0.0101237, "until_s": 0.0303333}


def table_of(kind: str) -> dict[str, Any]:
    """A table of any load: what must be given, and times within what is looked at."""
    fields = loads()[kind].table.model_fields
    required = {name: field for name, field in fields.items() if field.is_required() and name != "kind"}
    needed = {name: 5 if field.annotation is int else 1.25 for name, field in required.items()}
    return {"kind": kind} | needed | {name: s for name, s in ENDS.items() if name in fields}


def params_of(*kinds: str) -> Any:
    """Parameters of a motor with these loads."""
    given = {"dbc": "none.dbc", "motor": MOTOR, "firmware": FREE, "load": [table_of(kind) for kind in kinds]}
    return build_params(PlantConfig.model_validate(given), WIRE)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_a_record_has_the_tables_numbers_by_their_names(kind: str) -> None:
    member, given = loads()[kind], table_of(kind)
    record = params_of(kind)["load"][0]
    table = member.table.model_validate(given)
    for name in member.numbers:
        wanted = member.derived[name](table) if name in member.derived else getattr(table, name)
        assert record[name] == (math.inf if wanted is None else wanted), name
    others = set(LOAD.names or ()) - {"kind", *member.numbers}
    assert not any(record[name] for name in others)


@pytest.mark.parametrize("kind", VARYING)
@pytest.mark.parametrize("w_0", [7.0, -3.0])
def test_the_coefficients_of_a_load_are_the_series_of_its_torque(kind: str, w_0: float) -> None:
    load, member = params_of(kind)["load"][0], loads()[kind]
    assert member.torque and member.coefficient
    w = np.array([w_0, *np.random.default_rng(4).normal(size=ORDER) * 10.0 ** np.arange(1, ORDER + 1)])
    T, t = np.zeros(ORDER + 1), 0.37
    for k in range(ORDER + 1):
        T[k] = member.coefficient(load, T, w, t, k)
    for h in (0.0, 1e-4, 1e-3):
        exact = member.torque(load, t + h, evaluate(w, h))
        assert evaluate(T, h) == pytest.approx(exact, rel=1e-9, abs=1e-12), h
    assert np.abs(T[1:]).max() > 0


@pytest.mark.parametrize("kind", TURNED)
@pytest.mark.parametrize("w_0", [7.0, 0.0, -3.0])
def test_the_coefficients_of_a_load_by_the_angle_are_the_series_of_its_torque(kind: str, w_0: float) -> None:
    load, member = params_of(kind)["load"][0], loads()[kind]
    assert member.turned and member.angular
    w = np.array([w_0, *np.random.default_rng(4).normal(size=ORDER - 1) * 10.0 ** np.arange(1, ORDER)])
    theta = np.array([0.4, *(w / np.arange(1, ORDER + 1))])
    T, Q = np.zeros(ORDER + 1), np.zeros(ORDER + 1)
    for k in range(ORDER + 1):
        T[k] = member.angular(load, T, Q, theta, k)
    for h in (0.0, 1e-4, 1e-3):
        exact = member.turned(load, evaluate(theta, h))
        assert evaluate(T, h) == pytest.approx(exact, rel=1e-9, abs=1e-12), h
        assert theta[0] + integral(np.append(w, 0.0), h) == pytest.approx(evaluate(theta, h), rel=1e-15)
    assert np.abs(T[1:]).max() > 0


@pytest.mark.parametrize("kind", HELD)
def test_a_load_that_does_not_vary_is_constant_between_its_edges(kind: str) -> None:
    p, member = params_of(kind), loads()[kind]
    edges = [0.0]
    while len(edges) < 10 and (edge := float(edge_after(p, round(edges[-1])))) < 1e9:
        assert edge > edges[-1] + 0.5
        edges.append(edge)
    for begin, end in zip(edges, [*edges[1:], 1e9], strict=True):
        at = [begin + (end - begin) * share for share in (1e-6, 0.3, 0.999)]
        kernel = member.level or (lambda load, t: member.torque(load, t, 5.0))  # type: ignore[misc]
        assert len({kernel(p["load"][0], t * 1e-9) for t in at}) == 1, (begin, end)
    if member.level:
        assert load_torque(p, 0.02, 5.0) == 0.0 and member.level(p["load"][0], 0.02) >= 0.0


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not loads()[kind].level])
def test_a_motor_under_a_load_follows_dop853(kind: str) -> None:
    p = params_of(kind)
    s = new_state(np.atleast_1d(p), 15)[0]
    s["started"], s["state"], s["u_q"], s["u_d"] = 1, State.OPERATION_ENABLED.value, 60.0, -20.0
    drive.advance(p, s, 40_000_000)

    def rates(t: float, x: Any) -> list[float]:
        w, q, d, theta = x
        T = 4.5 * (0.7 * q + (0.02 - 0.033) * d * q)
        return [
            (T - load_torque(p, t, w, theta)) / 0.011,
            (60.0 - 2.0 * q - 3 * w * (0.02 * d + 0.7)) / 0.033,
            (-20.0 - 2.0 * d + 3 * w * 0.033 * q) / 0.02,
            w,
        ]

    x, t = np.zeros(4), 0.0
    while t < 0.04:
        end = min(edge_after(p, round(t * 1e9)) * 1e-9, 0.04)
        x = solve_ivp(rates, (t, end - 1e-15), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        t = end
    np.testing.assert_allclose(s["x"], x[:3], rtol=0, atol=1e-7)  # an edge is met to the nanosecond
    if p["turns"]:
        assert s["series"][ANGLE, 0] == pytest.approx(x[3], abs=1e-9)
    assert abs(x[0]) > 1.0


def test_the_order_of_loads_means_nothing_but_the_order_of_a_sum() -> None:
    ways = [params_of(*KINDS), params_of(*reversed(KINDS))]
    for t, w in [(0.0, 0.0), (0.02, 5.0), (0.02, -5.0), (0.5, 30.0)]:
        one, other = (load_torque(p, t, w, 0.3) for p in ways)
        assert one == pytest.approx(other, rel=1e-12) and edge_after(ways[0], 0) == edge_after(ways[1], 0)
        own = sum(load_torque(params_of(kind), t, w, 0.3) for kind in KINDS)
        assert one == pytest.approx(own, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_keys_and_reference_follow_from_the_row(kind: str) -> None:
    (table,) = [one for one in tables() if one.key == "plant:load" and one.kind == kind]
    assert [key.key.rpartition(".")[2] for key in table.keys] == list(loads()[kind].table.model_fields)
    assert kind in {key.kind for key in found("plant:load")}
    assert f'`[[load]]`, `kind = "{kind}"`' in (ROOT / "docs" / "reference-config.md").read_text()


def test_every_parameter_is_a_row_of_its_own_name() -> None:
    assert set(PARAMS.names or ()) == {*PARAMETERS, "load"}
    assert {row.type for row in PARAMETERS.values()} == {"f8", "i8"}


def test_a_kernel_is_as_old_as_the_loads_that_the_registry_found(tmp_path: Path) -> None:
    files = kernelcache.sources(ROOT / "firmware_model" / "drive.py")
    assert {Path(str(module.__file__)) for module in (brake, constant, sine)} <= files
    (tmp_path / "own").mkdir()
    for name in ("__init__", "press", "helper"):
        (tmp_path / "own" / f"{name}.py").touch()
    (tmp_path / "registry.py").touch()
    kernelcache.rests_on(str(tmp_path / "registry.py"), [tmp_path / "own" / "press.py"])
    assert {path.stem for path in kernelcache.sources(tmp_path / "registry.py")} == {
        "registry", "__init__", "press", "helper",
    }  # fmt: skip


class Named(Table):
    """A load with a text."""

    kind: Literal["named"]
    name: str


class Plain(Table):
    """A load."""

    kind: Literal["plain"]
    torque_n_m: Finite


@pytest.mark.parametrize(
    ("member", "said"),
    [
        (7, "MEMBER must be a"),
        (Load(Named, constant.torque), "name: keys of a load are numbers"),
        (Load(constant.ConstantLoad, constant.torque), "kind 'constant' is taken"),
        (Load(Plain), "a torque, .* or a level"),
        (Load(Plain, constant.torque, level=brake.level), "a torque, .* or a level"),
        (Load(Plain, coefficient=sine.coefficient, level=brake.level), "a torque, .* or a level"),
    ],
)
def test_a_load_that_can_not_be_is_refused_with_its_place(member: Any, said: str) -> None:
    with pytest.raises(PlantError, match=rf"hil\.loads: my_package:MEMBER: .*{said}"):
        _checked([("constant", constant.MEMBER), ("my_package:MEMBER", member)])


def installed(folder: Path, text: str) -> dict[str, str]:
    """A package with one load, as pip would leave it; the environment in which it is found."""
    package, facts = folder / "my_loads", folder / "my_loads-1.0.dist-info"
    package.mkdir()
    facts.mkdir()
    (package / "__init__.py").touch()
    (package / "press.py").write_text(text, encoding="utf-8")
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: my-loads\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text("[hil.loads]\npress = my_loads.press:MEMBER\n")
    own = {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), "NUMBA_DISABLE_JIT": "1"}
    return os.environ | own  # interpreted: the kernels of this one set of loads are not worth compiling


def hil(environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "hil.cli", *arguments],
        env=environment, cwd=ROOT, capture_output=True, text=True, timeout=240,
    )  # fmt: skip


@pytest.mark.long
def test_the_load_of_the_page_on_extending_runs_from_an_outside_package(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
    (example,) = [text for text in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "PressLoad" in text]
    environment = installed(tmp_path, example)
    told = hil(environment, "config", "explain", "plant:load.stroke_s")
    assert told.returncode == 0 and "From one stroke to the next" in told.stdout, told.stderr
    load = 'load=[{kind="press", torque_n_m=2.0, stroke_s=0.1, contact_s=0.02}]'
    short = ["--set=loop.duration_s=0.1", "--no-log"]
    ran = hil(environment, "simulate", str(CONFIGS / "demo.toml"), f"--plant-set={load}", *short)
    assert ran.returncode == 0, ran.stderr
    wrong = hil(environment, "simulate", str(CONFIGS / "demo.toml"), f"--plant-set={load[:-2]}, on_s=1}}]")
    assert wrong.returncode == 2 and "on_s: unknown key" in wrong.stderr, wrong.stderr


def test_an_outside_load_that_does_not_import_is_refused_in_one_line(tmp_path: Path) -> None:
    environment = installed(tmp_path, "import nowhere_at_all\n")
    said = hil(environment, "simulate", str(CONFIGS / "demo.toml"), "--no-log")
    assert said.returncode == 2 and len(said.stderr.strip().splitlines()) == 1, said.stderr
    assert "hil.loads: press = my_loads.press:MEMBER: ModuleNotFoundError" in said.stderr
