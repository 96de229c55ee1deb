"""The same configuration is the same controller on every processor, to the bit; and the right one."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.linalg import expm

from hil.control.linalg import exp, halvings_of, integral_exponential, inverse, power
from tests.conftest import CONFIGS, ROOT

SCRIPT = """
import sys
from pathlib import Path
from hil.app import Overrides, load_setup
for name, rate in (("demo", 500), ("demo", 1000), ("demo", 5000), ("paper", 1000), ("inverter", 1000)):
    setup = load_setup(Path(sys.argv[1]) / f"{name}.toml", Overrides(settings=(f"loop.rate_hz={rate}",)))
    print(setup.machine.to_json(), setup.machine.setpoint.tobytes().hex())
"""
PROCESSORS = {
    "this one": {},
    "an old one": {
        "OPENBLAS_CORETYPE": "Prescott",
        "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F,-AVX2_Usable,-FMA_Usable",
    },
    "another": {"OPENBLAS_CORETYPE": "Haswell"},
}


def designed(env: dict[str, str]) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCRIPT, str(CONFIGS)],
        env={**os.environ, **env}, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    return done.stdout


@pytest.mark.process
def test_a_design_has_the_same_bits_under_every_kind_of_blas_and_processor() -> None:
    first, *others = (designed(env) for env in PROCESSORS.values())
    assert first.count("\n") == 5 and all(other == first for other in others)


@pytest.mark.parametrize("seed", range(40))
def test_the_exponential_and_its_integral_are_scipys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, T = int(rng.integers(1, 5)), 10.0 ** rng.uniform(-5, 0)
    A = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-3, 2.5)
    A -= np.eye(n) * max(np.linalg.eigvals(A).real.max(), 0.0)
    whole = np.zeros((2 * n, 2 * n))
    whole[:n, :n], whole[:n, n:] = A, np.eye(n)
    wanted = expm(whole * T)
    Ad, Ed = integral_exponential(A, T, halvings_of(A, T))
    scale = 1e-14 * max(1.0, float(np.abs(A).sum(axis=1).max()) * T)
    assert np.abs(Ad - wanted[:n, :n]).max() <= scale * np.abs(wanted[:n, :n]).max()
    assert np.abs(Ed - wanted[:n, n:]).max() <= scale * np.abs(wanted[:n, n:]).max()
    assert np.abs(inverse(Ed) @ Ed - np.eye(n)).max() < 1e-15 * n * np.linalg.cond(Ed) + 1e-14


def test_scalars_are_rounded_right() -> None:
    assert exp(0.0) == 1.0 and exp(-1e4) == 0.0 and exp(1e4) == np.inf
    with localcontext() as context:
        context.prec = 60
        for x in np.random.default_rng(1).uniform(-40, 40, 200):
            assert exp(x) == float(Decimal(float(x)).exp())
            assert power(x, 17) == float(Decimal(float(x)) ** 17)
    assert exp(-720.0) == pytest.approx(math.exp(-720.0), rel=1e-15) and math.isnan(exp(math.nan))
    assert power(0.97, 0) == 1.0 and power(0.97, 1) == 0.97
    assert power(0.97, 250) == pytest.approx(0.97**250, rel=1e-14)
