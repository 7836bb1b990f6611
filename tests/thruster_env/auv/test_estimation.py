"""Filters on a vehicle that sails about at 20 Hz: consistent, and as accurate as the Riccati recursion says."""

import numpy as np
import pytest

from filters import make_filter, run
from tests.thruster_env.auv.problem import riccati_reference, sailing, sailing_model, scores
from thruster_env.core.compiled import interpreted

RUNS, STEPS = 10, 700


@pytest.fixture(scope="module")
def problem():
    with interpreted():  # 7000 steps are simulated sooner than compiled
        model = sailing_model()
        return model, *sailing(model, RUNS, STEPS)


@pytest.mark.slow
def test_the_extended_filter_of_eight_states_is_consistent_and_meets_the_reference(problem):
    """The NEES of a run of 30 s scatters by 0.55 about 8: 0.7 is four standard errors of the mean of ten.

    Pitch is correlated for seconds, so its RMSE is the least certain: by 4 %. With 50 runs of 60 s (seeds 0 to 49)
    extended and unscented filter have NEES 7.94 +- 0.06 and all RMSE within 1.8 % of the reference.
    """
    model, keys, inputs, truth = problem
    extended = make_filter("ekf", model)
    estimates = run(extended, keys, inputs, truth.measurements)
    with interpreted():
        again = run(extended, keys[:1], inputs[:1, :10], truth.measurements[:1, :11])
    np.testing.assert_allclose(estimates.means[:1, :11], again.means, rtol=1e-9, atol=1e-12)
    rmse, nees = scores(model, truth, estimates)
    assert nees.mean() == pytest.approx(8.0, abs=0.7)
    assert 0.1 < nees.std(ddof=1) < 0.9
    ratio = rmse / riccati_reference(model, inputs[:3, :400])
    assert (np.abs(ratio - 1.0) < [0.03, 0.03, 0.03, 0.05, 0.05, 0.03, 0.05, 0.12]).all(), ratio


@pytest.mark.usefixtures("as_python")
def test_the_unscented_filter_agrees_with_the_extended_one(problem):
    """Nonlinearity is weak between measurements: they differ by a hundredth of a standard deviation."""
    model, keys, inputs, truth = problem
    given = keys[:1], inputs[:1, :25], truth.measurements[:1, :26]
    extended, unscented = (run(make_filter(name, model), *given) for name in ("ekf", "ukf"))
    deviations = np.sqrt(np.diagonal(extended.covs, axis1=2, axis2=3))
    assert (np.abs(unscented.means - extended.means) < 0.05 * deviations).all()
    np.testing.assert_allclose(unscented.covs[:, 10:], extended.covs[:, 10:], rtol=0.05, atol=1e-9)
