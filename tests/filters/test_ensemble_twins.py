"""Ensemble filters over many runs against DAPPER's: the same errors and spread on the same measurements."""

import json
from pathlib import Path

import numpy as np
import pytest

from filters import make_filter, run
from tests.models import state_space
from thruster_env.core.streams import filter_keys

MOST_RESCALINGS = json.loads((Path(__file__).parents[1] / "data" / "dapper_twins.json").read_text())
RUNS = 16


def lorenz(x):
    return (10.0 * (x[1] - x[0]), 28.0 * x[0] - x[1] - x[0] * x[2], x[0] * x[1] - 8.0 / 3.0 * x[2])


def moved(x, h, k):
    return (x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2])


def step(x, u, c):
    """Lorenz's system of 1963 after 0.05 time units, by the classic Runge-Kutta method."""
    k1 = lorenz(x)
    k2 = lorenz(moved(x, 0.025, k1))
    k3 = lorenz(moved(x, 0.025, k2))
    k4 = lorenz(moved(x, 0.05, k3))
    for k, h in ((k1, 0.05 / 6), (k2, 0.05 / 3), (k3, 0.05 / 3), (k4, 0.05 / 6)):
        x = moved(x, h, k)
    return x


def whole(x, c):
    return (x[0], x[1], x[2])


@pytest.fixture(scope="module")
def model():
    mean, prior_cov = MOST_RESCALINGS["prior"]
    return state_space(
        step, whole, q=MOST_RESCALINGS["q"], r=MOST_RESCALINGS["r"], mean=mean, cov=prior_cov, substeps=2, inputs=0
    )


def errors_and_spread(filter_):
    """Root mean square error and root mean variance of RUNS runs (RUNS, 2), as in `data/dapper_twins.py`."""
    truth, first = np.array(MOST_RESCALINGS["truth"]), MOST_RESCALINGS["first scored"]
    z = np.vstack([np.full((1, 3), np.nan), MOST_RESCALINGS["z"]])  # nothing is seen of the initial state
    keys = filter_keys(range(RUNS))
    estimates = run(filter_, keys, np.zeros((RUNS, len(truth), 0)), np.repeat(z[None], RUNS, axis=0))
    errors = estimates.means[:, 1 + first :] - truth[first:]
    variances = np.einsum("bkii->bki", estimates.covs[:, 1 + first :])
    return np.sqrt(np.stack([(errors**2).mean(axis=(1, 2)), variances.mean(axis=(1, 2))], axis=1))


def apart(found, expected):
    """Difference of mean error and mean spread, in its standard errors (2,)."""
    standard_error = np.sqrt(sum(rows.var(axis=0, ddof=1) / len(rows) for rows in (found, expected)))
    assert (standard_error < 0.02 * expected.mean(axis=0)).all()  # or the comparison would say little
    return (found.mean(axis=0) - expected.mean(axis=0)) / standard_error


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("kind", ["enkf", "etkf", "denkf"])
def test_over_many_runs_errors_and_spread_are_those_of_dapper(kind, model):
    found = errors_and_spread(make_filter(kind, model, ensemble_size=MOST_RESCALINGS["members"]))
    difference = apart(found, np.array(MOST_RESCALINGS[kind]))
    assert (np.abs(difference) < 3.0).all()
    if kind == "enkf":
        # Perturbations that are centred, as DAPPER's are by default, help an ensemble of ten: the runs show that.
        centred, _ = apart(found, np.array(MOST_RESCALINGS["enkf, perturbations centred"]))
        assert centred > 3.0
