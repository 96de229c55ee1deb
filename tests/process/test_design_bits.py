"""The same configuration is the same controller, and a draw the same, on every processor, to the bit."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from hil.control.linalg import cos_sin, exp, halvings_of, integral_exponential, inverse, power, riccati
from tests.conftest import CONFIGS, ROOT
from tests.unit.test_control_registry import LAWS, OBSERVERS

SCRIPT = """
import sys
from pathlib import Path
from hil.runtime.setup import Overrides, load_setup
from tests.unit.test_control_registry import LAWS, OBSERVERS, config_of, settings
asked = [("demo", 500, ()), ("demo", 5000, ()), ("paper", 1000, ()), ("inverter", 1000, ())]
asked += [("demo", 1000, settings(observer=kind)) for kind in OBSERVERS]
asked += [(config_of(kind).stem, 1000, settings(law=kind)) for kind in LAWS]
noisy = 'kind="{0}", delay_ms=200.0, w_noise_rad_s=0.02, i_noise_a=0.03'.format
noisy = [noisy("least-noise"), noisy("harmonic-exact") + ", frequency_hz=7.3, lead_ticks=2.0"]
noisy += ['kind="exponentials", gammas_rad_s=[5.0, 11.0], delay_ms=300.0, w_noise_rad_s=0.02, i_noise_a=0.03']
noisy += ['kind="eso", bandwidth_rad_s=77.0, damping=1.0', 'kind="eso", bandwidth_rad_s=77.0, damping=1.9']
asked += [("demo", 1000, ("observer.speed={%s}" % one,)) for one in noisy]
for name, rate, more in asked:
    more = Overrides(settings=(f"loop.rate_hz={rate}", *more))
    setup = load_setup(Path(sys.argv[1]) / f"{name}.toml", more)
    print(setup.machine.to_json(), setup.machine.setpoint.tobytes().hex())
from hil.campaign.normal import between, normal, root
shares = [(2 * k + 1) / 40000 for k in range(20000)]
correlation = [[1.0, 0.3, 0.7], [0.3, 1.0, 0.1], [0.7, 0.1, 1.0]]
print([(normal(u), between(0.3, 7.0, u)) for u in shares], root(correlation))
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


@pytest.mark.long
@pytest.mark.process
@pytest.mark.beside
def test_a_design_has_the_same_bits_under_every_kind_of_blas_and_processor() -> None:
    first, *others = (designed(env) for env in PROCESSORS.values())
    assert first.count("\n") == 4 + len(OBSERVERS) + len(LAWS) + 5 + 1
    assert all(other == first for other in others)


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


@pytest.mark.parametrize("seed", range(40))
def test_the_riccati_equation_is_solved_as_scipy_does(seed: int) -> None:
    """A may be unstable where B reaches it; what no input reaches, or Q does not see, is stable."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 6)), int(rng.integers(1, 3))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    Q = np.diag(10.0 ** rng.uniform(-6, 3, n))
    P, wanted = riccati(A, B @ B.T, Q), solve_discrete_are(A, B, Q, np.eye(m))

    def missed(P: np.ndarray) -> float:
        return float(np.abs(A.T @ P @ np.linalg.solve(np.eye(n) + B @ B.T @ P, A) + Q - P).max() / P.max())

    assert np.abs(P - wanted).max() <= 1e-8 * wanted.max() and (P == P.T).all()
    assert missed(P) <= 10 * missed(wanted) + 1e-12


def test_a_riccati_equation_without_a_solution_has_none() -> None:
    with np.errstate(all="ignore"):
        assert not np.isfinite(riccati(np.array([[1.1]]), np.zeros((1, 1)), np.eye(1))).any()
    assert riccati(np.array([[0.5]]), np.eye(1), np.zeros((1, 1))) == 0.0


def test_scalars_are_rounded_right() -> None:
    assert cos_sin(0.0) == (1.0, 0.0) and cos_sin(-1.5)[1] == -cos_sin(1.5)[1]
    for x in np.random.default_rng(1).uniform(-1, 1, 200) * 10.0 ** np.arange(-8, 2).repeat(20):
        assert cos_sin(x) == pytest.approx((math.cos(x), math.sin(x)), rel=4e-16, abs=1e-300)
    assert exp(0.0) == 1.0 and exp(-1e4) == 0.0 and exp(1e4) == np.inf
    with localcontext() as context:
        context.prec = 60
        for x in np.random.default_rng(1).uniform(-40, 40, 200):
            assert exp(x) == float(Decimal(float(x)).exp())
            assert power(x, 17) == float(Decimal(float(x)) ** 17)
    assert exp(-720.0) == pytest.approx(math.exp(-720.0), rel=1e-15) and math.isnan(exp(math.nan))
    assert power(0.97, 0) == 1.0 and power(0.97, 1) == 0.97
    assert power(0.97, 250) == pytest.approx(0.97**250, rel=1e-14)
