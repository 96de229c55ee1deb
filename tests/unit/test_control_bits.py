"""Compiled and interpreted kernels give the same bytes: this file is the test and the script it runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np


def trace() -> bytes:
    """A few hundred ticks of every kernel that the drive laws and the paper's runs are made of."""
    from hil.control import composite, law, observer, references

    rng, out = np.random.default_rng(42), []
    motor = law.MotorModel(2.875, 0.022, 0.033, 0.8, 3, 0.011, 2e-4)
    for kind in ("cascade", "fac"):
        channel = law.ChannelSpec("ftdob", 25.0, 58.0, 12e-3)
        spec = law.LawSpec(kind, motor, channel, law.ChannelSpec("dob", 200.0), 30.0, 250.0, 250.0, 9.0, 5.0)
        p, s = law.design_law(spec, 1e-3)[0], law.new_law_state()
        for k in range(300):
            w, i_q, i_d = 80.0 + rng.normal(), rng.normal() * 3, rng.normal()
            if k == 150:
                law.reset(s[0])
            periods = 90 if k == 100 else int(rng.integers(1, 4))
            law.observe(p, s[0], w, i_q, i_d, bool(rng.random() > 0.2), periods)
            law.apply(s[0], s[0]["u"][0], s[0]["u"][1], s[0]["u"][2])
            law.command(p, s[0], 80.0 + 0.01 * k, 10.0, 1.5, 100.0 + k)
            out.append(s.tobytes())
    n = 4
    window = observer.ftdob(np.full(n, 3.0), np.full(n, 9.0), 0.02, 1e-3)
    h, past, d_hat, u = np.zeros((2, n)), np.zeros((32, 2, n)), np.zeros(n), np.zeros(n)
    Ad, Bd, Ed = (rng.normal(size=(n, n)) for _ in range(3))
    x, x_p, head = rng.normal(size=n), np.zeros(n), 0
    observer.fill(x, h, past)
    for _ in range(200):
        v = rng.normal(size=n) * 10.0 ** rng.integers(-3, 4)
        head = observer.window_step(window.lam, window.lam_N, window.theta, window.N, v, h, past, head, d_hat)
        composite.predict(Ad, Bd, Ed, v, u, d_hat, x_p)
        composite.composite_command(Ad, Bd, x_p, d_hat, v, u)
        u /= 1.0 + np.abs(u).max()
        out += [d_hat.tobytes(), x_p.tobytes(), u.tobytes(), h.tobytes()]
    profiles = [
        references.reference("step", w=80.0, at=0.5),
        references.reference("ramp", w=-80.0, at=0.2, rate=97.0, down_at=1.0),
        references.reference("s-curve", w=80.0, at=0.2, rate=97.0, jerk=1013.0, down_at=1.5),
        references.reference("table", table=([0.1, 0.5, 0.5, 2.0], [0.3, 40.0, 60.0, -10.0])),
    ]
    for profile in profiles:
        out += [np.array(references.reference_at(profile[0], 0.007 * k)).tobytes() for k in range(300)]
    return b"".join(out)


def run(disable_jit: bool) -> bytes:
    environment = os.environ | {"NUMBA_DISABLE_JIT": str(int(disable_jit))}
    done = subprocess.run(
        [sys.executable, str(Path(__file__))], env=environment, capture_output=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout


def test_compiled_and_interpreted_bytes_are_equal() -> None:
    compiled, interpreted = run(disable_jit=False), run(disable_jit=True)
    assert len(compiled) > 1_000_000
    assert compiled == interpreted, f"first difference at byte {first_difference(compiled, interpreted)}"


def first_difference(a: bytes, b: bytes) -> int:
    length = min(len(a), len(b))
    different = np.frombuffer(a[:length], np.uint8) != np.frombuffer(b[:length], np.uint8)
    return int(np.argmax(different)) if different.any() else length


if __name__ == "__main__":
    sys.stdout.buffer.write(trace())
