"""Ensemble filters against DAPPER's and Stone Soup's: the same analyses, errors and spread from the same data."""

import json
from pathlib import Path

import numpy as np
import pytest

from filters import EnsembleTransformFilter, make_filter, run
from tests.models import KEY, state_space, wide_model
from tests.oracles import each_close
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import filter_keys


def stay(x, u, c):
    return x


def curved(x, c):
    """What `data/dapper_analyses.py` measures."""
    return (x[0] + 0.2 * x[1] * x[1], x[0] * x[1] - 0.5 * x[2])


NUMBERS = {"ienkf": "iterations", "enkf-n": "certainty"}
DAPPER = json.loads((Path(__file__).parents[1] / "data" / "dapper_analyses.json").read_text())


@pytest.mark.parametrize("case", DAPPER, ids=lambda case: case["name"])
def test_the_same_ensemble_gives_the_same_ensemble_as_in_dapper(case):
    model = state_space(stay, curved, q=np.zeros((3, 3)), r=case["r"], mean=np.zeros(3), cov=np.ones(3))
    for name, posterior in case["posterior"].items():
        kind, _, number = name.partition(" ")
        numbers = {NUMBERS[kind]: int(number)} if number else {}
        filter_ = make_filter(kind, model, ensemble_size=10, **numbers)
        with interpreted():
            analysis, _ = filter_.update(filter_.init()._replace(members=np.array(case["prior"])), case["z"])
        np.testing.assert_allclose(analysis.mean, np.mean(posterior, axis=1), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(analysis.cov, np.cov(posterior), rtol=1e-9, atol=1e-9)
        # DAPPER makes channels independent by another root of R: moments agree, members where R is diagonal.
        if kind != "ensrf" or case["name"] == "uncorrelated":
            np.testing.assert_allclose(analysis.members, posterior, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("m", [1, 2])
def test_stone_soup_draws_from_the_same_moments(m, monkeypatch):
    pytest.importorskip("stonesoup")
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.types.array import StateVector, StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.prediction import EnsembleMeasurementPrediction, EnsembleStatePrediction
    from stonesoup.types.state import EnsembleState
    from stonesoup.updater.ensemble import EnsembleSqrtUpdater

    matrix, r = np.array([[1.0, 0.0, 0.5], [0.0, 2.0, -1.0]])[:m], np.array([[0.5, 0.2], [0.2, 0.3]])[:m, :m]
    model = wide_model(
        b=np.zeros((3, 0)),
        c=matrix,
        measurement_offset=np.zeros(m),
        measurement_noise_cov=r,
        prior_cov=[1.0, 0.5, 0.8],
    )
    filter_, z = EnsembleTransformFilter(model=model, ensemble_size=9), np.array([2.0, -1.0])[:m]
    with interpreted():
        forecast = filter_.predict(filter_.init(KEY), np.zeros(0))
        analysis, _ = filter_.update(forecast, z)

    drawn_from = []
    monkeypatch.setattr(
        EnsembleState, "generate_ensemble", lambda mean, cov, num_vectors: drawn_from.append((mean, cov))
    )
    seen = LinearGaussian(3, tuple(range(m)), r)
    monkeypatch.setattr(seen, "matrix", lambda **_: matrix)
    prediction = EnsembleStatePrediction(StateVectors(forecast.members))
    hypothesis = SingleHypothesis(
        prediction,
        Detection(StateVector(z), measurement_model=seen),
        EnsembleMeasurementPrediction(StateVectors(matrix @ forecast.members)),
    )
    EnsembleSqrtUpdater(seen).update(hypothesis)
    ((mean, cov),) = drawn_from
    each_close((analysis.mean, analysis.cov), (np.ravel(mean), cov), rtol=1e-9, atol=1e-9)


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
