"""Weight functions and scales of robust estimation."""

import numpy as np
import pytest

from uavkit.process.robust import (
    cut_variance,
    huber_psi,
    huber_weight,
    lmeds_scale,
    robust_scale,
    shrunk_scale,
    trimmed_scale,
    tukey_psi,
    tukey_weight,
)


def test_tukey_is_the_formula_of_the_method() -> None:
    z = np.array([0.0, 3.0, -3.0, 6.0, 7.0])
    np.testing.assert_allclose(tukey_weight(z, 6.0), [1.0, 0.5625, 0.5625, 0.0, 0.0])
    np.testing.assert_allclose(tukey_psi(z, 6.0), [0.0, 1.6875, -1.6875, 0.0, 0.0])


def test_huber() -> None:
    z = np.array([-4.0, -1.0, 0.0, 1.345, 2.69])
    np.testing.assert_allclose(huber_weight(z), [1.345 / 4.0, 1.0, 1.0, 1.0, 0.5])
    np.testing.assert_allclose(huber_psi(z), z * huber_weight(z))


def test_scales_of_normal_values() -> None:
    z = 2.5 * np.random.default_rng(1).normal(size=20_000)
    # The median magnitude has a relative sigma of 1.167 / sqrt(n) = 0.8 %.
    assert robust_scale(z) == pytest.approx(2.5, rel=0.03)
    assert trimmed_scale(z, 5.0) == pytest.approx(2.5, rel=0.03)
    assert lmeds_scale(z, 6) == pytest.approx(2.5, rel=0.03)


def test_trimmed_scale_resists_a_fifth_of_gross_errors() -> None:
    rng = np.random.default_rng(2)
    z = rng.normal(size=20_000)
    z[:4000] = rng.uniform(30, 3000, 4000)
    assert robust_scale(z) > 1.25
    assert trimmed_scale(z, 5.0) == pytest.approx(1.0, rel=0.03)


def test_small_group_keeps_its_stated_sigma() -> None:
    assert shrunk_scale(3.0, 0.0) == pytest.approx(1.0)
    assert shrunk_scale(3.0, 1e6) == pytest.approx(3.0, rel=1e-4)


def test_variance_behind_a_cut() -> None:
    z = np.random.default_rng(3).normal(size=1_000_000)
    for cut in (2.5, 3.0, 4.0):
        kept = z[np.abs(z) <= cut]
        assert cut_variance(cut) == pytest.approx(np.var(kept), abs=5e-3)
    assert cut_variance(4.0) == pytest.approx(0.99893, abs=1e-5)
