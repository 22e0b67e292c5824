"""Steps of points that their rays hardly determine, and the damping of steps."""

import numpy as np
import pytest
from bundle_blocks import Plan, simulate

from uavkit.core.adjustment import AdjustmentOptions, Datum
from uavkit.process.bundle import next_damping
from uavkit.process.bundle_system import Step, build_system, gauss_newton_step
from uavkit.process.kernels.bundle_normals import NEARLY_PARALLEL, _hold_back

POINT, CENTRE = np.array([10.0, 0.0, 0.0]), np.zeros(3)


@pytest.mark.parametrize(
    ("regularity", "step", "expected"),
    [
        (1e-3, [1.0, 2.0, 0.0], [1.0, 2.0, 0.0]),
        (1e-3, [30.0, 40.0, 0.0], [6.0, 8.0, 0.0]),
        (0.1 * NEARLY_PARALLEL, [5.0, 2.0, 0.0], [0.0, 2.0, 0.0]),
        (0.1 * NEARLY_PARALLEL, [-5.0, 2.0, 0.0], [-5.0, 2.0, 0.0]),
    ],
    ids=["short", "long", "away, nearly parallel rays", "back, nearly parallel rays"],
)
def test_step_of_a_point(regularity: float, step: list[float], expected: list[float]) -> None:
    moved = np.array(step)
    _hold_back(POINT, CENTRE, regularity, moved)
    np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_step_without_damping_gains_what_it_promises() -> None:
    plan = Plan(strips=2, images=5, points=150, length_m=40.0, width_m=26.0)
    block = simulate(np.random.default_rng(1), plan, start_error=0.01)
    system = build_system(block.observations, Datum.CONTROL, AdjustmentOptions().default_shift_sigma_m)
    step = gauss_newton_step(system, system.start(), system.full_weights(), 0.0)
    assert step.gain == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("gain", "factor"), [(0.9, 0.1), (0.2, 1.0), (0.05, 10.0)])
def test_damping_follows_the_gain(gain: float, factor: float) -> None:
    plan = Plan(strips=2, images=5, points=150, length_m=40.0, width_m=26.0)
    block = simulate(np.random.default_rng(1), plan)
    system = build_system(block.observations, Datum.CONTROL, AdjustmentOptions().default_shift_sigma_m)
    step = Step(state=system.start(), damping=1e-5, size=1.0, gain=gain, determined=np.ones(3, dtype=bool))
    assert next_damping(step) == pytest.approx(1e-4 * factor)
