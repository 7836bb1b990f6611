"""Any filter under numbers that no plant sends, huge, tiny and missing: finite estimates, restarts counted."""

import numpy as np
import pytest

from filters import FILTERS, make_filter, run, thruster_model
from filters.registry import filter_type
from tests.models import OF_EACH_KIND
from tests.slow import slow_but

RUNS, STEPS = 1000, 100
EXTREME = [0.0, 5e-324, 1e-300, 1e8, -1e8, 1e30, -1e30, 1e154, -1e154, 1e300, -1e300, 1e308]


def ordinary_and_extreme(rng, shape, extremes):
    odd = rng.choice(extremes, size=shape)
    return np.where(rng.random(shape) < 0.5, rng.normal(size=shape) * 5.0, odd)


@pytest.fixture(scope="module")
def data():
    """100 000 steps: half of the runs with voltages that a plant may take, one in ten without a measurement."""
    rng = np.random.default_rng(0)
    keys = rng.integers(0, 2**32, (RUNS, 2)).astype(float)
    inputs = ordinary_and_extreme(rng, (RUNS, STEPS, 1), EXTREME)
    inputs[: RUNS // 2] = np.clip(inputs[: RUNS // 2], -24.0, 24.0)
    measurements = ordinary_and_extreme(rng, (RUNS, STEPS + 1, 1), [np.nan, *EXTREME])
    measurements[::10] = np.nan
    return keys, inputs, measurements


@pytest.mark.parametrize("name", slow_but(FILTERS, OF_EACH_KIND))
def test_every_estimate_is_finite_and_every_restart_counted(name, data):
    numbers = {"ensemble_size": 12} if filter_type(name).has_ensemble else {}
    estimates = run(make_filter(name, thruster_model(), **numbers), *data)
    for part in estimates:
        assert np.isfinite(part).all()
    assert (estimates.covs == np.swapaxes(estimates.covs, -1, -2)).all()
    variances = np.einsum("bkii->bki", estimates.covs)
    assert (variances >= 0.0).all()
    assert (estimates.divergences > 0).sum() > RUNS // 4  # such numbers do lose a filter
    # Where nothing is measured and the voltages are possible, nothing can go wrong.
    assert (estimates.divergences[: RUNS // 2 : 10] == 0).all()
