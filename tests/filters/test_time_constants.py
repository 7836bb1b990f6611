"""Time constants of gains: closed forms, other ways to compute them, and the noise by which a filter forgets."""

import math

import numpy as np
import pytest

from filters import affine_model, make_filter, run
from filters.bounds import steady_state
from filters.consistency.time_constants import forgetting_noise, slopes_along, time_constants
from tests.linear_problem import LinearProblem
from tests.models import affine, state_space
from tuning.problems.data import runs_of

DT = 0.1


pytestmark = pytest.mark.usefixtures("as_python")


def walk(q):
    """A random walk that is measured with a variance of 1."""
    one = [[1.0]]
    return affine(one, [[0.0]], one, q=[q], r=1.0, mean=[0.0], cov=[1.0])


def cart(q=(1e-12, 1e-12), blind=False):
    """Position, velocity and, if blind, a distance that nothing measures; the position is measured to 0.1 m."""
    n = 3 if blind else 2
    a = np.eye(n)
    a[0, 1] = a[-1, 1] = DT
    a[1, 1] = 1.0
    return affine(a, np.zeros((n, 1)), np.eye(1, n), q=[*q, 1e-3][:n], r=0.01, mean=[0.0] * n, cov=[1.0] * n)


def runs(steps, missing=0.0):
    """A run without inputs, a part of whose measurements is missing."""
    generator = np.random.default_rng(3)
    z = generator.standard_normal((1, steps + 1, 1))
    z[generator.random(z.shape) < missing] = np.nan
    return [(np.array([[1.0, 2.0]]), np.zeros((1, steps, 1)), z)]


@pytest.mark.parametrize("q", (1.0, 0.01))
def test_of_a_random_walk_it_is_that_of_riccatis_equation(q):
    p = q / 2 + math.sqrt(q * q / 4 + q)  # predicted: p^2 = q p + q
    found = time_constants(make_filter("kf", walk(q)), runs(200))
    assert found.steps == pytest.approx([-1.0 / math.log(1.0 - p / (p + 1.0))], rel=1e-9)
    assert found.uptake == pytest.approx(found.steps[0], rel=1e-9) and found.length == 200


def test_a_filter_without_process_noise_sleeps_and_one_without_any_gain_never_forgets():
    found = time_constants(make_filter("kf", walk(0.0)), runs(200))  # K = 1 / (k + 2)
    assert found.steps[0] == pytest.approx(0.5 * (150 + 200), rel=0.15)
    still = time_constants(make_filter("kf", walk(0.0).replace(prior_cov=[0.0])), runs(20))
    assert still.steps == (math.inf,) and still.uptake == math.inf
    assert time_constants(make_filter("open-loop", walk(1.0)), runs(20)) is None


def test_all_time_constants_are_those_of_the_eigenvalues_and_the_state_is_named():
    model = LinearProblem(3, 2).model(process_noise_cov=[1e-4, 0.02, 1e-6])
    a, _, _, c, _ = model.matrices()
    gain = steady_state(a, c, model.process_noise_cov, model.measurement_noise_cov)[1]
    values = np.sort(np.abs(np.linalg.eigvals((np.eye(3) - gain @ c) @ a)))[::-1]
    data = LinearProblem(3, 2, steps=300).data([0])
    data = data._replace(measurements=np.nan_to_num(data.measurements))
    found = time_constants(make_filter("kf", model), runs_of(data))
    np.testing.assert_allclose(found.steps, -1.0 / np.log(values), rtol=1e-6)
    assert found.slowest == 2 and not found.unobservable


def test_that_of_an_ensemble_is_that_of_its_sample_gain():
    model, some = cart((1e-4, 1e-3)), runs(120)
    exact, sampled = (
        time_constants(make_filter(name, model, **given), some)
        for name, given in (("kf", {}), ("etkf", {"ensemble_size": 40}))
    )
    np.testing.assert_allclose(sampled.steps, exact.steps, rtol=0.25)


def test_without_measurements_errors_last_longer_and_what_is_not_observable_is_named():
    all_there, some_missing = (
        time_constants(make_filter("kf", walk(0.01)), runs(300, part)) for part in (0.0, 0.8)
    )
    assert 1.2 * all_there.steps[0] < some_missing.steps[0] < 5.0 * all_there.steps[0]
    blind = time_constants(make_filter("kf", cart((1e-4, 1e-3), blind=True)), runs(60))
    assert blind.unobservable == (2,) and len(blind.steps) == 2


def test_a_fix_every_fifty_steps_counts_as_often_as_it_comes():
    q, every, ((keys, inputs, z),) = 0.01, 50, runs(1000)
    z[:, np.arange(1001) % every != 10] = np.nan
    found = time_constants(make_filter("kf", walk(q)), [(keys, inputs, z)])
    q *= every  # of the walk between two fixes
    p = q / 2 + math.sqrt(q * q / 4 + q)
    assert found.steps == pytest.approx([-every / math.log(1.0 - p / (p + 1.0))], rel=1e-6)


@pytest.mark.parametrize("blind", (False, True))
def test_the_least_floor_makes_the_steady_gain_forget_in_the_time_that_is_allowed(blind):
    model = cart(blind=blind)
    path = slopes_along(make_filter("kf", model), runs(100))
    q, steps = forgetting_noise(path, model, 2.0 / DT)
    assert 0.99 * 2.0 < steps * DT <= 2.0
    raised = model.replace(process_noise_cov=q)
    a, c = (part[:2, :2] for part in (model.matrices()[0], model.matrices()[3]))
    gain = steady_state(a, c, q[:2, :2], model.measurement_noise_cov)[1]
    values = np.abs(np.linalg.eigvals((np.eye(2) - gain @ c) @ a))
    assert -DT / np.log(values.max()) == pytest.approx(2.0, rel=2e-3)
    np.testing.assert_array_equal(forgetting_noise(path, raised, 2.0 / DT).cov, raised.process_noise_cov)
    assert np.linalg.eigvalsh(q - model.process_noise_cov).min() > -1e-15
    assert time_constants(make_filter("kf", raised), runs(300)).steps[0] == pytest.approx(20.0, rel=2e-3)


def test_a_q_that_is_large_enough_stays_and_nothing_to_forget_is_refused():
    model = walk(1.0)
    path = slopes_along(make_filter("kf", model), runs(40))
    np.testing.assert_array_equal(forgetting_noise(path, model, 5.0).cov, [[1.0]])
    with pytest.raises(ValueError, match="must observe a state, but its measurements tell of none"):
        forgetting_noise(path._replace(observations=0.0 * path.observations), model, 5.0)


def test_along_slopes_that_change_it_is_the_mean_growth_of_errors():
    noise = {"q": [1e-3, 1e-4], "r": 0.1}
    prior = {"mean": [0.0, 1.0], "cov": [1.0, 1.0]}
    model = state_space(
        lambda x, u, c: (0.9 * x[0] + u[0] * x[1], x[1]), lambda x, c: (x[0],), **noise, **prior, inputs=1
    )
    keys, z = np.array([[1.0, 2.0]]), np.zeros((1, 301, 1))
    filter_, square = make_filter("ekf", model), np.sign(np.sin(np.arange(300) / 1.0))[None, :, None]
    found = time_constants(filter_, [(keys, square, z)])
    # In the mean over steps the input is zero, and nothing would be known of what it multiplies.
    model, (estimates, n) = filter_.kernel_model, (run(filter_, keys, square, z), 150)
    product = np.eye(2)
    for k in range(n + 1, 301):
        f = np.array([[0.9, square[0, k - 1, 0]], [0.0, 1.0]])
        p = f @ estimates.covs[0, k - 1] @ f.T + model.process_noise_cov
        gain = p[:, :1] / (p[0, 0] + 0.1)
        product = (np.eye(2) - gain @ [[1.0, 0.0]]) @ f @ product
    slowest = -(300 - n) / math.log(np.abs(np.linalg.eigvals(product)).max())
    assert found.slowest == 1 and not found.unobservable and found.steps[0] == pytest.approx(slowest, rel=0.2)


def test_a_constant_is_remembered_while_the_other_states_forget():
    drifting = affine_model(  # a random walk whose drift is a constant
        a=[[1.0, 1.0], [0.0, 1.0]],
        b=np.zeros((2, 1)),
        c=[[1.0, 0.0]],
        process_noise_cov=[0.01, 0.0],
        measurement_noise_cov=1.0,
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0, 1e-9],
    )
    filter_ = make_filter("kf", drifting)
    assert time_constants(filter_, runs(300)).steps[0] > 300
    (steps,) = time_constants(make_filter("kf", walk(0.01)), runs(300)).steps
    assert time_constants(filter_, runs(300), [1]).steps == pytest.approx([steps], rel=1e-3)
    path = slopes_along(filter_, runs(300))
    cov, reached = forgetting_noise(path, drifting, 0.5 * steps, constants=[1])
    assert reached == pytest.approx(0.5 * steps, rel=2e-3)
    assert cov[0, 0] > 0.02 and (cov[1] == 0.0).all() and (cov[:, 1] == 0.0).all()
