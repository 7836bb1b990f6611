"""Ensemble filters against other people's: the same ensemble and measurement in, the same analysis out."""

import json
from pathlib import Path

import numpy as np
import pytest

from filters import EnsembleTransformFilter, make_filter
from tests.models import KEY, state_space, wide_model
from thruster_env.core.compiled import interpreted


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
    np.testing.assert_allclose(analysis.mean, np.ravel(mean), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(analysis.cov, cov, rtol=1e-9, atol=1e-9)
