"""Other people's estimators: a run is a function of its key and its data, whatever they draw from or remember."""

import random

import numpy as np
import pytest

from filters import run
from filters.estimators.foreign import Estimator
from filters.registry import make_filter
from tests.models import random_affine

KEYS = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
STEPS = 6


class Walks(Estimator):
    """Draws its estimate, and remembers all that it ever drew."""

    has_covariance = False

    def __init__(self, n, draw):
        self.n, self.draw, self.count = n, draw, 0.0

    def reset(self, key, z):
        return self.step(None, z)

    def step(self, u, z):
        self.count += 1.0
        if u is not None:
            u[:] = np.nan  # its own copies, to do with what it likes
        z[:] = np.nan
        return np.full(self.n, self.draw() + self.count)


class AtOnce(Estimator):
    """All runs at once, from the global generator, and what it remembers."""

    has_covariance = False

    def __init__(self, n, draw):
        self.n, self.draw, self.count = n, draw, 0.0

    def run(self, keys, inputs, measurements):
        self.count += 1.0
        draws = [[self.draw() + self.count for _ in range(measurements.shape[1])] for _ in keys]
        return np.repeat(np.array(draws)[..., None], self.n, axis=2)


def torchs():
    return float(pytest.importorskip("torch").randn(()))


@pytest.fixture
def data():
    model = random_affine(2)
    rng = np.random.default_rng(2)
    return model, rng.normal(size=(3, STEPS, model.inputs)), rng.normal(size=(3, STEPS + 1, model.m))


def unseeded():
    """Draws of generators of its own, which nobody seeds."""
    return np.random.default_rng().normal


DRAWS = [np.random.normal, random.random, torchs, unseeded(), lambda: np.random.normal()]


@pytest.mark.parametrize("draw", DRAWS)
def test_a_run_is_a_function_of_its_key_and_data(draw, data):
    model, inputs, measurements = data
    inputs.setflags(write=False)
    draw()
    before = np.random.get_state()[1].copy(), random.getstate()
    filter_ = make_filter(Walks(model.n, draw), model)
    whole = run(filter_, KEYS, inputs, measurements).means
    np.testing.assert_array_equal(np.random.get_state()[1], before[0])
    assert random.getstate() == before[1], "what others draw goes on as it would"
    assert len(np.unique(np.round(whole[..., 0] % 1.0, 12))) == whole[..., 0].size, "each run draws its own"
    for b in reversed(range(3)):
        alone = run(filter_, KEYS[b : b + 1], inputs[b : b + 1], measurements[b : b + 1]).means
        np.testing.assert_array_equal(alone[0], whole[b])
        session = filter_.session()
        session.start(KEYS[b], measurements[b, 0])
        means = [session.mean.copy()]
        for k in range(STEPS):
            draw()  # somebody else's
            session.step(inputs[b, k], measurements[b, k + 1])
            means.append(session.mean.copy())
        np.testing.assert_array_equal(means, whole[b])


@pytest.mark.parametrize("draw", DRAWS)
def test_all_runs_at_once_are_the_same_again(draw, data):
    model, inputs, measurements = data
    filter_ = make_filter(AtOnce(model.n, draw), model)
    first, again = (run(filter_, KEYS, inputs, measurements).means for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = run(filter_, KEYS[::-1].copy(), inputs, measurements).means
    assert not np.array_equal(first, other)


def test_sessions_in_turns_keep_their_own_generators(data):
    model, inputs, measurements = data
    filter_ = make_filter(Walks(model.n, np.random.normal), model)
    whole = run(filter_, KEYS, inputs, measurements).means
    sessions = [filter_.session() for _ in KEYS]
    for session, key, z in zip(sessions, KEYS, measurements, strict=True):
        session.start(key, z[0])
    for k in range(STEPS):
        for b, session in enumerate(sessions):
            session.step(inputs[b, k], measurements[b, k + 1])
            np.testing.assert_array_equal(session.mean, whole[b, k + 1])


def test_what_draws_from_a_generator_that_nobody_can_seed_is_refused(data):
    model, inputs, measurements = data
    hidden = np.random.default_rng(1)
    filter_ = make_filter(Walks(model.n, lambda: hidden.normal()), model)
    rule = (
        "the estimator 'Walks' must give the same for the same key and data, but when run 0 is repeated, its mean"
    )
    with pytest.raises(ValueError, match=rule) as caught:
        run(filter_, KEYS, inputs, measurements)
    assert "\n" not in str(caught.value)
