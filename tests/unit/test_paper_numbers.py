"""Every printed number to its printed digits, every computed error to what the errata give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.config.design import motor_model
from hil.config.motor import MotorTable
from hil.config.toml import read_toml
from hil.paper.continuous import channel_theta, lag, simulate, theta
from hil.paper.errata import steady_voltage
from hil.paper.examples import (
    PHI,
    RECONSTRUCTION,
    case_1,
    case_3,
    feedforward,
    pmsm_as_printed,
    reference_terms,
    section_5,
    section_6,
)
from hil.paper.printed import case_3_errors, identities
from hil.paper.study import Study, after_levels, make_study, noise_gain
from tests.conftest import ROOT


@pytest.fixture(scope="module")
def study() -> Study:
    return make_study()


def test_theta_of_section_5_to_its_printed_digits() -> None:
    e = section_5()
    printed = np.array([[-2.0332] * 3, [3.0332] * 3])
    np.testing.assert_array_equal(channel_theta(e.gamma, e.D).round(4), printed)
    full = np.hstack([np.diag(row) for row in printed])
    np.testing.assert_array_equal(theta(e.gamma, e.D).round(4), full)


def test_theta_of_section_6_to_its_printed_digits() -> None:
    e = section_6()
    printed = [[-2.8583, 0, 3.8583, 0], [0, 5.5167, 0, -4.5167]]
    np.testing.assert_array_equal(theta(e.gamma, e.D).round(4), printed)


def test_pi_of_both_sections_to_its_printed_digits() -> None:
    np.testing.assert_allclose(section_5().Pi, [[0.7, -1, -1.6], [0, 2.8, -2], [0, 0, 5.7]], atol=1e-12)
    np.testing.assert_allclose(section_6().Pi, [[0.0031, -3.6], [2.4, 2.8618]], atol=1e-12)


def test_the_right_sign_turns_pi_12_and_nothing_else() -> None:
    expected = [[0.0031, 3.6], [2.4, 2.8618]]
    np.testing.assert_allclose(section_6(torque_sign=1.0).Pi, expected, atol=1e-12)


@pytest.mark.parametrize("name", identities())
def test_the_reconstruction_satisfies_the_identity(name: str) -> None:
    printed, computed = identities()[name]
    assert computed == pytest.approx(printed, abs=1e-12)


def test_the_shipped_preset_is_the_reconstruction_and_says_so() -> None:
    path: Path = ROOT / "configs/motors/reconstruction.toml"
    assert motor_model(MotorTable.model_validate(read_toml(path))) == RECONSTRUCTION
    assert "Not a citation" in path.read_text(encoding="utf-8")


def test_case_1_errors(study: Study) -> None:
    run = study.runs["case 1"]
    for t in (0.5, 3.5, 6.5):
        k = run.at(t)
        assert np.abs(run.continuous.error[k]).max() < 1e-14, t
        assert np.abs(run.sampled.error[k]).max() < 1e-14, t
        assert np.abs(run.continuous.error[k - 1]).max() > 1e-4, "not before D"
    e = np.abs(run.continuous.error_c)
    found = [e[run.at(0.5), 2], e[run.at(3.5), 1], e[run.at(3.5), 2]]
    np.testing.assert_array_equal(np.round(found, 3), [0.144, 0.189, 0.223])


def test_case_1_at_half_d(study: Study) -> None:
    run = study.runs["case 1"]
    k, step = run.at(3.25), np.array([0.4, 0.5])
    ours = np.abs(run.continuous.error[k, 1:]) / step
    theirs = np.abs(run.continuous.error_c[k, 1:]) / step
    assert 0.365 < ours.min() <= ours.max() < 0.385
    assert 0.665 < theirs.min() <= theirs.max() < 0.695


def test_case_2_is_exact_d_after_each_level(study: Study) -> None:
    run = study.runs["case 2"]
    rows = after_levels(run)
    assert len(rows) == 61
    assert np.abs(run.continuous.error[rows]).max() < 1e-13
    assert np.abs(run.sampled.error[rows]).max() < 1e-13
    assert np.abs(run.continuous.error_c[rows]).max() > 0.05


def test_case_3_errors(study: Study) -> None:
    run = study.runs["case 3"]
    ours, theirs = case_3_errors(run.continuous, run.case)
    assert ours == pytest.approx((4.3e-3, 5.2e-4), rel=0.02)
    assert theirs == pytest.approx((1.46e-2, 1.56e-3), rel=0.005)
    sampled, _ = case_3_errors(run.sampled, run.case)
    assert sampled == pytest.approx(ours, rel=1e-3)


def test_the_error_is_below_the_bound_of_the_window_and_not_far_below(study: Study) -> None:
    e = case_3().example
    ours, _ = case_3_errors(study.runs["case 3"].continuous, case_3())
    bound = 0.0205 * lag(e.gamma, e.D)[0]
    assert 0.9 * bound < ours[0] < bound


def test_lag_and_noise_of_the_window() -> None:
    D = 0.5
    assert lag(np.array([[1e-3], [2e-3]]), D)[0] == pytest.approx(D / 2, rel=1e-3)
    gains = [noise_gain(g) for g in ((0.003, 0.007), (0.3, 0.7), (1.0, 3.0))]
    assert [round(gains[0], 2), round(gains[1], 1), round(gains[2], 1)] == [1.41, 1.6, 3.3]


def test_the_printed_plant_is_unstable_and_the_motor_is_not() -> None:
    wrong = sorted(np.linalg.eigvals(section_6().A).real)
    right = np.linalg.eigvals(section_6(torque_sign=1.0).A)
    np.testing.assert_array_equal(np.round(wrong, 1), [-203.9, 116.7])
    np.testing.assert_array_equal(right.real.round(1), [-43.6, -43.6])
    np.testing.assert_array_equal(np.abs(right.imag).round(), [148, 148])


def test_reference_terms_inside_d() -> None:
    d = reference_terms(section_6()) + PHI
    assert d[0] == pytest.approx(-499.9, abs=0.05)
    assert d[1] == pytest.approx(-36494, abs=0.5)


def test_the_paper_s_own_form_peaks_at_thousands_of_amperes(study: Study) -> None:
    peak = float(np.abs(study.runs["PMSM as printed"].continuous.x[:, 1]).max())
    assert peak == pytest.approx(7608, rel=0.01)
    fine = simulate(replace(pmsm_as_printed(), end=1.0), dt=1e-3)
    assert peak == pytest.approx(float(np.abs(fine.x[:, 1]).max()), rel=1e-4), "the grid decides nothing"
    assert np.abs(study.runs["PMSM corrected"].continuous.x[:, 1]).max() < 0.1


def test_voltage_that_the_references_need() -> None:
    assert round(steady_voltage(electrical=False)) == 1204
    assert round(steady_voltage(electrical=True)) == 404
    assert feedforward()[1] == pytest.approx(steady_voltage(electrical=False), rel=1e-12)


def test_speed_is_not_controlled_without_the_load_machine() -> None:
    """With u_q alone (i_q decoupled and held) the speed keeps the pole of its friction, 55 s."""
    m, e = RECONSTRUCTION, section_6(torque_sign=1.0)
    decoupled = np.array([[0.0, 0.0], -e.A[1] / e.B[1, 1] + [0.0, -0.4 / e.B[1, 1]]])
    poles = np.sort(np.linalg.eigvals(e.A + e.B @ decoupled).real)
    np.testing.assert_allclose(poles, [-0.4, -m.B_f / m.J], rtol=1e-9)


def test_the_start_of_section_5_violates_10_and_is_harmless_after_d(study: Study) -> None:
    case, run = case_1(), study.runs["case 1"]
    h = (case.z0 + case.example.gamma.ravel() * np.tile(case.x0, 2)).reshape(2, 3)
    np.testing.assert_allclose(h[0] - h[1], [-0.08, 0, 0.16], atol=1e-12)
    difference = np.abs(study.zero_fill.d_hat - run.continuous.d_hat[: study.zero_fill.t.size]).max(axis=1)
    assert difference[: run.at(0.5)].min() > 1e-4
    assert difference[run.at(0.5) :].max() < 1e-14


def test_fixed_time_is_at_rounding_from_tick_n_on_and_only_in_the_exact_form(study: Study) -> None:
    c = study.convergence
    assert c.initial[0] == pytest.approx(1e-3)
    assert c.initial[-1] == pytest.approx(1e3)
    scale = np.maximum(c.initial, 1.0)[:, None]
    assert (c.ftdob[:, c.N :] / scale).max() < 2e-14
    assert (c.ftdob[:, c.N - 1] / c.initial).min() > 1e-4, "not a tick earlier"
    assert (c.euler[:, c.N :] / c.initial[:, None]).min() > 1e-3
    assert (c.dob[:, c.N] / c.initial).min() > 0.4
    assert c.euler[-1, c.N :].max() / c.initial[-1] == pytest.approx(6.6e-3, rel=0.02)
