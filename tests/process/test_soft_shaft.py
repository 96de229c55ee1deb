"""A soft shaft on the default bus: the demo closes its loop over it and replays; `--verify` foretells it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli import main
from hil.log.reader import open_log
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate_ticks
from hil.tuning.bench import bench_of, plant_settings, simulated, spec_in
from hil.tuning.families import settings_of
from hil.tuning.optimise import law_of
from hil.tuning.verify import off, same_run, verify
from tests.conftest import CONFIGS
from tests.unit.test_soft_shaft_keys import soft

pytestmark = [pytest.mark.process, pytest.mark.beside, pytest.mark.slow]
Settings = Callable[..., tuple[str, ...]]
DESIGN: dict[str, dict[str, Any]] = {
    "controller": {"kind": "cascade", "speed_pole_rad_s": 186.9, "current_pole_rad_s": 601.5},
    "speed": {"kind": "cubic", "delay_ms": 18.0},
    "current": {"kind": "cubic", "delay_ms": 19.0},
}
"""What `hil design configs/demo.toml --shaft 60` finds, about."""
RIGID = dict.fromkeys(("J", "psi_f", "R_s", "L"), 0.0)


def test_the_demo_on_a_soft_shaft_is_the_simulated_run_and_replays(
    configs: Path, settings: Settings, capsys: pytest.CaptureFixture[str]
) -> None:
    own = settings('loop.clock="lockstep"', "loop.duration_s=4.0")
    rigid = simulate_ticks(load_setup(configs / "demo.toml", Overrides(settings=own)))
    path = soft(configs)
    assert main(["demo", str(path), "--json", *(word for one in own for word in ("--set", one))]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["replay"]["verdict"] == "same" and said["ended"] == "stop_requested"
    bus = open_log(Path(said["log"])).ticks
    simulated = simulate_ticks(load_setup(path, Overrides(settings=own)))
    assert len(bus) > 4000 and same_run(simulated, bus)
    assert 3.0 < said["dip_rad_s"] < 6.0 and said["tracking_rms_rad_s"] < 1.0
    assert not np.array_equal(bus["w"][:4000], rigid["w"][:4000])


@pytest.mark.long
def test_a_design_on_a_soft_shaft_is_foretold_and_the_bus_has_the_same_bits(tmp_path: Path) -> None:
    """The plant of the file and the motor that is believed in; corners differ from them by a setting."""
    own = Overrides(settings=("loop.duration_s=4.0", f'log.folder="{tmp_path}"'))
    demo, seen = CONFIGS / "demo.toml", list[int]()
    law = law_of(DESIGN, spec_in(load_setup(demo, own)), 1e-3)
    found = verify(demo, own, DESIGN, {}, RIGID, law, seen.append, ((60.0, 0.01, 0.5),))
    _, believed = found["rows"]
    assert found["ok"] and found["bus_same"] and seen == [1, 2], found
    designed = Overrides(settings=(*own.settings, *settings_of(DESIGN)))
    stiff = plant_settings(bench_of(demo, load_setup(demo, designed), spread=RIGID))[0]
    assert believed["dip"] > 1.1 * simulated(demo, designed, stiff).dip, "at first the motor's end alone dips"
    assert off(1.1, 1.0) == pytest.approx(0.1) and math.isinf(off(math.inf, math.inf))


def test_a_coupling_of_the_plants_file_is_the_shaft_of_the_bench(configs: Path) -> None:
    path = soft(configs)
    bench = bench_of(path, load_setup(path, Overrides()))
    assert bench.shafts == (pytest.approx((60.0, 0.01, 0.5)),) and bench.brake
    every = plant_settings(bench)
    assert len(every) == 17 and all(one[1].startswith("coupling={inertia_ratio = 1.0") for one in every)
