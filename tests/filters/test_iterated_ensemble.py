"""The iterated ensemble filter, also with a window: N x N textbooks, DAPPER's iEnKS, linear models, Lorenz-63."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import inv, sqrtm
from scipy.optimize import minimize_scalar

from filters import EnsembleTransformFilter, IteratedEnsembleKalmanFilter, make_filter, run
from filters.c.project import c_filter
from filters.ensembles.square_root import record_members
from filters.smoothers import smooth_ensembles
from filters.tensors import torch
from tests.filters.checks import refused
from tests.filters.test_ensemble_peers import step, whole
from tests.models import KEY, plane_model, random_affine, simulated, state_space, varying_noise
from tests.oracles import each_close
from thruster_env.core.streams import filter_keys
from thruster_env.model.simulate import simulate

pytestmark = pytest.mark.usefixtures("as_python")

SIZE = 9


def stay(x, u, c):
    return x


def curved(x, c):
    return (x[0] + 0.2 * x[1] * x[1], x[0] * x[1])


def curved_model(**changes):
    prior = {"mean": [1.0, -0.5], "cov": [[0.8, 0.2], [0.2, 0.5]]}
    return state_space(stay, curved, q=[0.1, 0.1], r=[[0.5, 0.2], [0.2, 0.3]], **prior, **{"inputs": 0, **changes})


def updated(kind, model, z, **numbers):
    filter_ = kind(model=model, **{"ensemble_size": SIZE, **numbers})
    forecast = filter_.predict(filter_.init(KEY), np.zeros(model.inputs))
    return (forecast, *filter_.update(forecast, z))


def test_its_first_iteration_is_the_transform_filter_with_its_innovation():
    model, z = curved_model(), [1.9, -1.4]
    _, first, innovation = updated(IteratedEnsembleKalmanFilter, model, z, iterations=1)
    _, third, same = updated(IteratedEnsembleKalmanFilter, model, z, iterations=3)
    _, by_transform, of_transform = updated(EnsembleTransformFilter, model, z)
    np.testing.assert_allclose(first.members, by_transform.members, rtol=1e-13)
    assert not np.allclose(third.members, first.members, rtol=1e-3)
    for other in (same, of_transform):
        each_close((np.ravel(innovation.cov), innovation.value), (np.ravel(other.cov), other.value), rtol=1e-13)
        assert innovation.log_likelihood == pytest.approx(other.log_likelihood, rel=1e-13)


def test_where_measurements_are_linear_further_iterations_change_nothing():
    model = plane_model(b=np.zeros((2, 0)))
    _, once, _ = updated(IteratedEnsembleKalmanFilter, model, [2.0, -1.0], iterations=1)
    _, often, _ = updated(IteratedEnsembleKalmanFilter, model, [2.0, -1.0], iterations=20)
    np.testing.assert_allclose(often.members, once.members, rtol=1e-10, atol=1e-10)


def test_iterations_end_at_the_most_probable_state():
    """After a good measurement the members lie close together: the slopes they give are derivatives."""

    def cubed(x, c):
        return (x[0] ** 3,)

    model = curved_model(
        observe=cubed, process_noise_cov=[0.0], measurement_noise_cov=1e-2, prior_mean=[1.0], prior_cov=[0.04]
    )
    z, numbers = 2.5, {"ensemble_size": 40}
    forecast, analysis, _ = updated(IteratedEnsembleKalmanFilter, model, [z], iterations=10, **numbers)
    _, by_transform, _ = updated(EnsembleTransformFilter, model, [z], **numbers)

    def loss(x):
        return (x - forecast.mean[0]) ** 2 / forecast.cov[0, 0] + (z - cubed((x,), ())[0]) ** 2 / 1e-2

    most_probable = minimize_scalar(loss, bounds=(0.5, 2.0), method="bounded", options={"xatol": 1e-9}).x
    spread = analysis.cov[0, 0] ** 0.5
    assert abs(analysis.mean[0] - most_probable) < 0.05 * spread
    assert abs(by_transform.mean[0] - most_probable) > 2.0 * spread


DAPPER = json.loads((Path(__file__).parents[1] / "data" / "dapper_windows.json").read_text())


def spring(x, u, c):
    """What `data/dapper_windows.py` moves."""
    return (x[0] + 0.3 * x[1], x[1] - 0.3 * x[0] * (1.0 + 0.2 * x[0] * x[0]), 0.9 * x[2] + 0.2 * x[0] * x[1])


def curved_of_three(x, c):
    """What it measures."""
    return (x[0] + 0.2 * x[1] * x[1], x[0] * x[1] - 0.5 * x[2])


def pushed(x, u, c):
    moved = spring(x, u, c)
    return (moved[0], moved[1] + 0.2 * u[0], moved[2])


def windowed_model(**changes):
    noise = {"q": [[0.1, 0.05, 0.0], [0.05, 0.2, 0.0], [0.0, 0.0, 0.1]], "r": [[0.5, 0.2], [0.2, 0.3]]}
    prior = {"mean": [1.0, -0.5, 2.0], "cov": [0.6, 0.2, 1.5]}
    return state_space(pushed, curved_of_three, **noise, **prior, **{"inputs": 1, "substeps": 2, **changes})


class Textbook:
    """The IEnKS, every transform N x N, of the window's start and its process noise."""

    def __init__(self, model, start, lag, iterations, inflation, relaxation):
        self.model, self.lag, self.iterations = model, lag, iterations
        self.inflation, self.relaxation = inflation, relaxation
        self.start, self.noise, self.inputs = start, [], []

    def moved(self, x, u, w):
        for _ in range(self.model.substeps):
            x = np.array([self.model.functions.transition(tuple(one), u, ()) for one in x.T]).T
        return x + w

    def now(self, stacked):
        x, *noise = np.split(stacked, 1 + len(self.noise))
        for u, w in zip(self.inputs, noise, strict=True):
            x = self.moved(x, u, w)
        return x

    @property
    def stacked(self):
        return np.vstack([self.start, *self.noise])

    @stacked.setter
    def stacked(self, rows):
        self.start, *self.noise = np.split(rows, 1 + len(self.noise))

    def predict(self, u, w):
        if self.lag == 0:
            self.start = self.moved(self.start, u, w)
        elif len(self.noise) == self.lag:
            self.start = self.moved(self.start, self.inputs.pop(0), self.noise.pop(0))
        if self.lag:
            self.noise.append(w)
            self.inputs.append(u)
        mean = self.stacked.mean(axis=1, keepdims=True)
        self.stacked = mean + self.inflation * (self.stacked - mean)

    def update(self, z):
        seen = ~np.isnan(z)
        if not seen.any():
            return
        size = self.start.shape[1]
        mean, inverse = self.stacked.mean(axis=1), inv(self.model.measurement_noise_cov[np.ix_(seen, seen)])
        far, w, transform = self.stacked - mean[:, None], np.zeros(size), np.eye(size)
        for _ in range(self.iterations):
            x = self.now((mean + far @ w)[:, None] + far @ transform)
            y = np.array([self.model.functions.observe(tuple(one), ()) for one in x.T]).T[seen]
            slopes = (y - y.mean(axis=1, keepdims=True)) @ inv(transform)
            hessian = (size - 1) * np.eye(size) + slopes.T @ inverse @ slopes
            w = w - inv(hessian) @ ((size - 1) * w - slopes.T @ inverse @ (z[seen] - y.mean(axis=1)))
            transform = sqrtm((size - 1) * inv(hessian)).real
        after = far @ transform
        kept = self.relaxation * (far.std(axis=1) / after.std(axis=1) - 1.0)
        self.stacked = (mean + far @ w)[:, None] + (1.0 + kept)[:, None] * after


@pytest.mark.parametrize(
    ("lag", "iterations", "inflation", "relaxation"),
    [(0, 1, 1.0, 0.0), (0, 7, 1.1, 0.3), (1, 3, 1.0, 0.0), (2, 1, 1.1, 0.0), (3, 4, 1.05, 0.3)],
)
def test_every_member_is_the_textbook_s(lag, iterations, inflation, relaxation):
    model = windowed_model()
    numbers = {"iterations": iterations, "inflation": inflation, "relaxation": relaxation}
    filter_ = make_filter("ienkf", model, ensemble_size=SIZE, window=lag, **numbers)
    plain = make_filter("ienkf", model, ensemble_size=SIZE)
    inputs, z = simulated(model, 8)
    z[0, 3, 1] = z[0, 6] = np.nan
    belief, nothing = filter_.init(KEY), np.zeros((3, SIZE))
    textbook = Textbook(model, belief.members[:3], lag, iterations, inflation, relaxation)
    for k in range(9):
        if k > 0:
            # The noise that a filter without a window adds to members at rest, where f is zero.
            rest = plain.init(KEY)._replace(members=nothing, step=k - 1)
            w = plain.predict(rest, np.zeros(1)).members
            belief = filter_.predict(belief, inputs[0, k - 1])
            textbook.predict(inputs[0, k - 1], w)
            np.testing.assert_allclose(belief.members[:3], textbook.now(textbook.stacked), rtol=1e-9, atol=1e-9)
        forecast, (belief, innovation) = belief.members[:3], filter_.update(belief, z[0, k])
        textbook.update(z[0, k])
        rows = len(textbook.stacked)
        stored = belief.members[3 : 3 + rows] if lag else belief.members
        np.testing.assert_allclose(stored, textbook.stacked, rtol=1e-8, atol=1e-8)
        now = textbook.now(textbook.stacked)
        each_close((belief.members[:3], belief.mean), (now, now.mean(axis=1)), rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(belief.cov, np.cov(now), rtol=1e-8, atol=1e-8)
        expected = np.where(
            np.isnan(z[0, k]), 0.0, z[0, k] - np.mean([curved_of_three(x, ()) for x in forecast.T], axis=0)
        )
        np.testing.assert_allclose(innovation.value, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("case", DAPPER, ids=lambda case: f"lag {case['lag']}")
def test_without_process_noise_it_is_dapper_s(case):
    model = windowed_model(
        transition=spring, process_noise_cov=np.zeros(3), measurement_noise_cov=case["r"], inputs=0, substeps=1
    )
    lag, prior = case["lag"], np.array(case["prior"])
    filter_ = make_filter("ienkf", model, ensemble_size=10, window=lag, iterations=case["iterations"])
    belief = filter_.init()
    belief.members[:3] = belief.members[3:6] = prior
    for k, z in enumerate(case["z"]):
        belief, _ = filter_.update(filter_.predict(belief, np.zeros(0)), z)
        if k >= lag:
            np.testing.assert_allclose(belief.members[3:6], case["starts"][k - lag], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("lag", [1, 4])
def test_of_a_linear_model_every_step_is_that_without_a_lag(lag):
    model = plane_model()
    inputs, z = simulated(model, 15, count=2, missing=0.3)
    for own, noise in (({}, varying_noise(model, 15)), ({"inflation": 1.1}, {})):
        without, with_window = (
            make_filter("ienkf", model, ensemble_size=SIZE, window=number, **own) for number in (0, lag)
        )
        found, expected = (run(filter_, None, inputs, z, **noise) for filter_ in (with_window, without))
        each_close(found, expected, rtol=1e-10, atol=1e-10)


def test_a_window_of_one_step_nearly_halves_the_error_on_lorenz_s_system():
    """Of 1963, measured every 0.25 time units: the motion of the members is not linear within their spread."""
    model = state_space(
        step, whole, q=[1e-6] * 3, r=[2.0] * 3, mean=[1.5, -1.5, 25.0], cov=[2.0] * 3, inputs=0, substeps=5
    )
    nothing = np.zeros((2, 200, 0))
    drawn = simulate(model, filter_keys(range(2)), nothing)

    def rmse(window):
        filter_ = make_filter("ienkf", model, ensemble_size=10, inflation=1.02, window=window)
        return ((run(filter_, None, nothing, drawn.measurements).means - drawn.states)[:, 50:] ** 2).mean() ** 0.5

    assert rmse(1) < 0.6 * rmse(0)


def test_members_of_now_are_recorded():
    model = plane_model(process_noise_cov=[[0.3, 0.1], [0.1, 0.2]])
    filter_ = make_filter("ienkf", model, ensemble_size=SIZE, window=2, relaxation=0.2, inflation=1.05)
    inputs, z = simulated(model, 12, missing=0.2)
    recorded = record_members(filter_, np.array([KEY]), inputs, z)
    assert recorded.members.shape == (1, 13, 2, SIZE) and recorded.weights is None


@pytest.mark.slow
def test_large_models_are_called():
    model = random_affine(38, 8, 1)
    inputs, z = simulated(model, 4)
    without, with_window = (
        run(make_filter("ienkf", model, ensemble_size=6, window=lag, iterations=2), None, inputs, z)
        for lag in (0, 2)
    )
    np.testing.assert_allclose(with_window.means, without.means, rtol=1e-8, atol=1e-8)


def test_what_a_window_does_not_allow_is_refused():
    filter_ = make_filter("ienkf", plane_model(), window=2)
    for use, where in ((torch, "on tensors"), (c_filter, "in C")):
        refused(f"ensemble {where} must have a page .* got 'ienkf' with a window of 2", use, filter_)
    nothing = np.zeros((1, 1, 2)), np.zeros((1, 2, 2))
    with pytest.raises(ValueError, match="one gain for all states, but got 'ienkf' with a window of 2"):
        smooth_ensembles(filter_, np.array([KEY]), *nothing, 1, (np.empty((0, 2, 2)), np.empty((0, 2, 2))))
