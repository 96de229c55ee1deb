"""The paper's two worked examples as data: system (30), the PMSM of (32) to (34), and their disturbances.

Everything here is printed in the paper except what is said to be assumed: the random signal of case 2, the
start of the observers of Sect. 6, and the motor, whose Table 1 is missing (a reconstruction, not a citation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from hil.control.composite import continuous_gain
from hil.control.law import MotorModel
from hil.control.linalg import Array

RECONSTRUCTION: Final = MotorModel(R_s=2.875, L_d=0.033, L_q=0.033, psi_f=0.8, n_p=3, J=0.011, B_f=2e-4)
"""The round motor that satisfies the four identities of the printed Pi; the same as motors/reconstruction."""

W_REF: Final = 500.0  # rad/s, Sect. 6
I_Q_REF: Final = 1.5  # A, Sect. 6
PHI: Final = np.array([0.1, 0.2])  # rad/s2, A/s: the disturbance of Sect. 6
OMEGA: Final = (0.05, 0.02)  # rad/s: the sines of case 3
SEED: Final = 20240101  # of the levels assumed for case 2
BASIS: Final = 1 + 2 * len(OMEGA)


@dataclass(frozen=True, slots=True)
class Example:
    """A system x' = A x + B u + d with the paper's observers and controller; n channels.

    ``gamma`` (2, n), ``gamma_c`` (n,) [rad/s]: poles of FTDOB and conventional DOB; ``D`` [s];
    ``Upsilon``, ``Z`` (n, n) of Theorem 2.
    """

    A: Array
    B: Array
    gamma: Array
    gamma_c: Array
    D: float
    Upsilon: Array
    Z: Array

    @property
    def n(self) -> int:
        """Number of channels."""
        return int(self.A.shape[0])

    @property
    def Pi(self) -> Array:
        """Gain of Theorem 2, eq. (24)."""
        return continuous_gain(self.A, self.B, self.Upsilon, self.Z)


@dataclass(frozen=True, slots=True)
class Disturbance:
    """d(t) = C_s basis(t) on the pieces [breaks_s, breaks_{s+1}), right-continuous; C (pieces, n, BASIS)."""

    breaks: Array
    C: Array

    def piece(self, t: Array) -> npt.NDArray[np.int64]:
        """Index of the piece at each time; a hair of tolerance, so that grid times fall on breaks."""
        return np.maximum(np.searchsorted(self.breaks, np.asarray(t) + 1e-9, side="right") - 1, 0)

    def __call__(self, t: Array) -> Array:
        """Value at the times t (k,); shape (k, n)."""
        values: Array = np.einsum("knb,kb->kn", self.C[self.piece(t)], basis(t))
        return values


@dataclass(frozen=True, slots=True)
class Case:
    """One simulation: an example, its disturbance, start x0, z0 (2n,), z_c0 (n,), and the end time [s]."""

    name: str
    example: Example
    d: Disturbance
    x0: Array
    z0: Array
    z_c0: Array
    end: float


def basis(t: Array) -> Array:
    """(1, sin, cos of each OMEGA) at the times t (k,); shape (k, BASIS)."""
    t = np.asarray(t, float)
    columns = [np.ones_like(t)]
    for omega in OMEGA:
        columns += [np.sin(omega * t), np.cos(omega * t)]
    return np.stack(columns, axis=-1)


def basis_rate() -> Array:
    """S of basis' = S basis; shape (BASIS, BASIS)."""
    S = np.zeros((BASIS, BASIS))
    for i, omega in enumerate(OMEGA):
        S[1 + 2 * i, 2 + 2 * i], S[2 + 2 * i, 1 + 2 * i] = omega, -omega
    return S


def levels(breaks: list[float], values: list[list[float]]) -> Disturbance:
    """Piecewise constant disturbance: values[s] holds from breaks[s] on."""
    C = np.zeros((len(values), len(values[0]), BASIS))
    C[:, :, 0] = values
    return Disturbance(np.array(breaks), C)


def section_5() -> Example:
    """Example (30) with the observers and the controller of Sect. 5."""
    return Example(
        A=np.array([[-0.8, 1.0, 1.6], [0.0, -3.0, 2.0], [0.0, 0.0, -6.0]]),
        B=np.eye(3),
        gamma=np.array([[0.6, 0.7, 0.8], [1.4, 1.5, 1.6]]),
        gamma_c=np.array([1.4, 1.5, 1.6]),
        D=0.5,
        Upsilon=-np.diag([0.1, 0.2, 0.3]),
        Z=np.eye(3),
    )


def section_6(motor: MotorModel = RECONSTRUCTION, torque_sign: float = -1.0) -> Example:
    """PMSM of (34), x = (w - w*, i_q - i_q*), u = (T_L, u_q). torque_sign -1 is the paper's, +1 is right."""
    torque = torque_sign * motor.k_t / motor.J
    back_emf = -motor.n_p * motor.psi_f / motor.L_q
    return Example(
        A=np.array([[-motor.B_f / motor.J, torque], [back_emf, -motor.R_s / motor.L_q]]),
        B=np.diag([-1.0 / motor.J, 1.0 / motor.L_q]),
        gamma=np.array([[0.2, 0.5], [0.8, 0.1]]),
        gamma_c=np.array([0.2, 0.5]),
        D=0.5,
        Upsilon=-np.diag([0.3, 0.4]),
        Z=np.eye(2),
    )


def reference_terms(example: Example) -> Array:
    """A x* of (34) for constant references: the known terms that the paper puts into d; (2,)."""
    terms: Array = example.A @ np.array([W_REF, I_Q_REF])
    return terms


def _case_5(name: str, d: Disturbance, x0: list[float], end: float) -> Case:
    z0 = np.array([0.1, 0.0, 0.0, 0.1, 0.0, 0.0])
    return Case(name, section_5(), d, np.array(x0), z0, np.array([0.1, 0.0, 0.0]), end)


def case_1() -> Case:
    """Constant values with steps at 3 s and 6 s."""
    d = levels([0, 3, 6], [[0.2, 0, 0], [0.2, 0.4, -0.5], [0.2, 0.4, 0]])
    return _case_5("case 1", d, [0.1, 0.0, -0.2], 40.0)


def case_2() -> Case:
    """Random levels of +-0.1 from 40 s to 100 s, each held 1 s: assumed, the paper does not define them."""
    signs = np.random.default_rng(SEED).choice([-0.1, 0.1], size=(60, 3))
    values = [[0.0] * 3, *signs.tolist(), [0.0] * 3]
    return _case_5("case 2", levels([0, *range(40, 101)], values), [1.0, 0.0, -2.0], 120.0)


def case_3() -> Case:
    """Slow sines; d_2 falls from 0.1 to 0 at 30 s."""
    C = np.zeros((2, 3, BASIS))
    C[:, 0, 1], C[:, 0, 4] = 0.01, 1.0  # 0.01 sin 0.05 t + cos 0.02 t
    C[0, 1, 0] = 0.1
    C[:, 2, 2] = 0.05  # 0.05 cos 0.05 t
    return _case_5("case 3", Disturbance(np.array([0.0, 30.0]), C), [1.0, 0.0, -2.0], 200.0)


def _case_6(name: str, example: Example, d: Array) -> Case:
    """Sect. 6 from x0 = (0.1, 0) with d_hat(0) = 0 (assumed: the paper gives no z0), so z0 = -Gamma x0."""
    x0 = np.array([0.1, 0.0])
    z0 = -np.concatenate([example.gamma[0] * x0, example.gamma[1] * x0])
    return Case(name, example, levels([0], [d.tolist()]), x0, z0, -example.gamma_c * x0, 20.0)


def pmsm_as_printed() -> Case:
    """Sect. 6 as printed: wrong sign of a1 b1, reference terms inside d."""
    example = section_6()
    return _case_6("PMSM as printed", example, reference_terms(example) + PHI)


def pmsm_corrected() -> Case:
    """Right sign, known terms in the model (as a feedforward u*), so that d = phi; the same poles."""
    return _case_6("PMSM corrected", section_6(torque_sign=1.0), PHI)


def feedforward(motor: MotorModel = RECONSTRUCTION) -> Array:
    """u* = (T_L [N m], u_q [V]) that holds (w*, i_q*) in the model: A x* + B u* = 0."""
    example = section_6(motor, torque_sign=1.0)
    u: Array = -np.linalg.solve(example.B, reference_terms(example))
    return u
