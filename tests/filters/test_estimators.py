"""Other people's estimators in the place of a filter: contract, comparison, wrappers, repeated runs."""

import copy
import math
import random

import gymnasium as gym
import numpy as np
import pytest

from filters import EstimateState, make_filter, run
from filters.estimators.foreign import Estimator
from filters.wrappers.envs import EstimateStates
from tests.filters.checks import refused
from tests.models import random_affine, simulated
from tests.oracles import each_close
from tuning.evaluation.baselines import scaled_default
from tuning.evaluation.compare import compare, contender
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.tuned import check_keepable
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds
from tuning.problems.problem import Parameter
from tuning.search.space import choice_of, distributions

NOMINAL, SEEDS = find_scenario("nominal"), held_out_seeds(0, 4)
HERE = "tests.filters.test_estimators"


class Textbook(Estimator):
    """The Kalman filter of an affine model as a user may write it, on arrays, channels left out where missing."""

    def __init__(self, model):
        self.a, self.b, self.f, self.h, self.h0 = model.matrices()
        self.model = model

    def reset(self, key, z):
        self.x, self.p = self.model.prior_mean, self.model.prior_cov
        return self.updated(z)

    def step(self, u, z):
        self.x = self.a @ self.x + self.b @ u + self.f
        self.p = self.a @ self.p @ self.a.T + self.model.process_noise_cov
        return self.updated(z)

    def updated(self, z):
        there = ~np.isnan(z)
        h, r = self.h[there], self.model.measurement_noise_cov
        v, s = np.zeros(len(z)), r.copy()
        v[there] = (z - self.h @ self.x - self.h0)[there]
        s[np.ix_(there, there)] += h @ self.p @ h.T
        if there.any():
            gain = np.linalg.solve(s[np.ix_(there, there)], h @ self.p).T
            self.x, self.p = self.x + gain @ v[there], self.p - gain @ h @ self.p
        return self.x, self.p, v, s


class Scripted(Estimator):
    """Gives what it is told, a mean alone by default, from the third step on; before that, zeros."""

    def __init__(self, given=(0.0, 0.0), has_covariance=False, **others):
        self.given, self.has_covariance, self.count = given, has_covariance, 0
        vars(self).update(others)

    def reset(self, key, z):
        self.count, self.key = 0, key
        return (np.zeros(2), np.eye(2)) if self.has_covariance else np.zeros(2)

    def step(self, u, z):
        self.count += 1
        if isinstance(self.given, Exception):
            raise self.given
        return self.given if self.count >= 3 else self.reset_again()

    def reset_again(self):
        return (np.zeros(2), np.eye(2)) if self.has_covariance else np.zeros(2)


class Drawing:
    """No subclass of ours: a random mean that follows from the key, and the last measurement as innovation."""

    has_covariance = False

    def __init__(self, model=None):
        pass

    def reset(self, key, z):
        self.generator = np.random.default_rng(key)
        return self.step(None, z)

    def step(self, u, z):
        return self.generator.normal(size=2)


class AtOnce(Estimator):
    """Many runs in one call: the mean is (u, z), where z is there."""

    has_covariance = False

    def __init__(self, model=None):
        pass

    def run(self, keys, inputs, measurements):
        u = np.concatenate([np.zeros_like(inputs[:, :1]), inputs], axis=1)
        return np.concatenate([u, np.nan_to_num(measurements)], axis=-1)

    def reset(self, key, z):
        return self.step([0.0], z)

    def step(self, u, z):
        return np.nan_to_num(np.concatenate([u, z]))


def scaled_gain(model, gain=1.0):
    """What makes an estimator of a model and of one number."""
    return Scripted(given=np.array([gain, 0.0]), model=model) if gain > 1 else AtOnce()


scaled_gain.parameters = [Parameter("gain", 1.0, 4.0, log=False, default=2.0)]


def data_of(model, missing=()):
    inputs, measurements = simulated(model)
    for place in missing:
        measurements[place] = math.nan
    return np.zeros((len(inputs), 2)), inputs, measurements


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("missing", [(), [(0, 3), (0, 5, 1), (0, 0, 0)]])
def test_a_user_s_kalman_filter_gives_what_ours_gives_missing_channels_and_likelihood_too(missing):
    model = random_affine(n=3, m=2, p=1, seed=5)
    data = data_of(model, missing)
    ours, theirs = run(make_filter("kf", model), *data), run(make_filter(Textbook, model), *data)
    each_close(ours, theirs, rtol=1e-8, atol=1e-9)


def test_an_estimator_stands_in_evaluation_and_comparison_beside_ours():
    data = NOMINAL.data(SEEDS)
    found = evaluate(make_filter(AtOnce(), NOMINAL.model()), data, NOMINAL.scale)
    u = np.concatenate([np.zeros_like(data.inputs[:, :1]), data.inputs], axis=1)
    errors = np.concatenate([u, data.measurements], axis=-1) - data.states
    expected = np.sqrt((errors[:, data.late] ** 2).mean(axis=(0, 1)))
    np.testing.assert_allclose([one.value for one in found.rmse], expected, rtol=1e-12)
    assert math.isnan(found.nees.value) and math.isnan(found.nis.value) and math.isnan(found.log_likelihood)
    drawing = Drawing()
    (board,), _ = compare([contender("ekf"), contender(AtOnce()), contender(drawing)], [NOMINAL], SEEDS)
    assert [row.label for row in board.rows] == ["ekf", "AtOnce", "Drawing"]
    assert [row.verdict for row in board.rows] == ["tie", "worse", "worse"]
    assert board.rows[1].evaluation.rmse == found.rmse and not hasattr(drawing, "generator")
    assert "has no NIS" in scaled_default(f"{HERE}:AtOnce", NOMINAL).reason


def test_many_at_once_are_one_after_the_other_and_randomness_follows_from_the_key():
    data = NOMINAL.data(SEEDS)
    given = data.filter_keys, data.inputs[:, :9], data.measurements[:, :10].copy()
    given[2][0, 4] = math.nan
    alone = AtOnce()
    alone.run = None
    for one, other in zip(
        run(make_filter(AtOnce(), NOMINAL.model()), *given), run(make_filter(alone, NOMINAL.model()), *given),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_array_equal(one, other)
    drawn = run(make_filter(Drawing(), NOMINAL.model()), *given).means
    again = run(make_filter(Drawing(), NOMINAL.model()), *(part[1:] for part in given)).means
    np.testing.assert_array_equal(drawn[1:], again)
    assert (drawn[0] != drawn[1]).all()


def test_a_covariance_without_an_innovation_has_a_nees_but_no_nis_and_no_likelihood():
    estimator = Scripted((np.zeros(2), np.array([4e4, 4.0])), has_covariance=True)
    found = evaluate(make_filter(estimator, NOMINAL.model()), NOMINAL.data(SEEDS), NOMINAL.scale)
    assert found.nees.value > 0 and math.isnan(found.nis.value) and math.isnan(found.log_likelihood)


@pytest.mark.parametrize(
    ("estimator", "rule"),
    [
        (Scripted((1.0, 2.0)), "mean of .* 'Scripted' must be numbers of shape .* got shape .1,. at step 3"),
        (Scripted(np.array([1.0, math.nan])), "mean of .* 'Scripted' must be finite, .* step 3 of run 0"),
        (Scripted(np.zeros(3)), r"must be numbers of shape \(2,\), but got shape \(3,\) at step 3 of run 0"),
        (Scripted("text"), "must be numbers of shape .* but got 'text' at step 3"),
        (Scripted(None), "must be numbers of shape .* but got None at step 3"),
        (Scripted(ZeroDivisionError("by zero")), "its step raised ZeroDivisionError: by zero at step 1 of run 0"),
        (Scripted((np.zeros(2), -np.eye(2)), True), "covariance of .* symmetric and positive semidefinite"),
        (Scripted((np.zeros(2), [[1.0, 0.5], [0.0, 1.0]]), True), "must be symmetric and positive"),
        (Scripted((np.zeros(2), np.eye(3)), True), r"must be numbers of shape \(2, 2\), but got shape \(3, 3\)"),
        (Scripted(np.zeros(2), True), "must give a covariance, or say has_covariance = False"),
        (Scripted((0,) * 5), "must give a mean, or a tuple .* but gave a tuple of 5 at step 3 of run 0"),
        (Scripted(run=lambda *_: np.zeros((4, 2))), r"shape \(4, 501, 2\), but got shape \(4, 2\) at run"),
        (Scripted(run=lambda k, u, z: np.full((*z.shape[:2], 2), np.nan)), "not at step 0 of run 0"),
        (Scripted(run=lambda k: 0), "must not raise, but its run raised TypeError"),
    ],
)  # fmt: skip
def test_what_an_estimator_gets_wrong_is_one_line_with_the_rule_and_where(estimator, rule):
    data = NOMINAL.data(SEEDS)
    refused(rule, evaluate, make_filter(estimator, NOMINAL.model()), data, NOMINAL.scale)


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ("nosuch_module:thing", "estimator must be 'module:object' that can be imported, but .* No module named"),
        ("math:nothing", "'math:nothing' is not: module 'math' has no attribute"),
        ("math:pi", "must be an estimator, or make one of a model, but it is 3.14"),
        ("math:sin", "must be made of a model, but raised TypeError"),
        (lambda model: 3, "must make an object with reset.* but made 3"),
        ("nobody", "filter must be one of kf"),
        (Estimator(), "its reset raised NotImplementedError: Estimator has no reset"),
    ],
)
def test_what_is_no_estimator_is_refused(given, rule):
    with pytest.raises(ValueError, match=rule):
        run(make_filter(given, NOMINAL.model()), np.zeros((1, 2)), np.zeros((1, 1, 1)), np.zeros((1, 2, 1)))


def test_what_needs_a_filter_of_ours_says_so():
    filter_ = make_filter(AtOnce(), NOMINAL.model())
    for call in (filter_.init, filter_.kernels, lambda: filter_.predict(None, [0.0])):
        refused("needs a filter of filters.FILTERS, but got the estimator 'AtOnce'", call)
    with pytest.raises(ValueError, match="cannot vary from step to step"):
        run(
            filter_, np.zeros((1, 2)), np.zeros((1, 1, 1)), np.zeros((1, 2, 1)), process_noise_covs=np.eye(2)[None]
        )
    rule = "numbers must come with a function that makes an estimator, .* and got gain"
    refused(rule, make_filter, AtOnce(), NOMINAL.model(), gain=2.0)


def test_what_it_says_it_is_tuned_by_a_study_may_choose_but_no_file_keeps():
    name = f"{HERE}:scaled_gain"
    assert distributions(name, NOMINAL)["gain"].high == 4.0 and "Q11" in distributions(name, NOMINAL)
    choice = choice_of(name, {"gain": 3.0, "R": 0.5}, NOMINAL)
    filter_ = choice.filter(NOMINAL)
    assert filter_.estimator.given[0] == 3.0 and filter_.estimator.model.measurement_noise_cov[0, 0] == 0.5
    assert choice_of(name, {}, NOMINAL).numbers == {"gain": 2.0}
    refused("a tuned file must be of a filter of filters.FILTERS, but got", check_keepable, name)


class Wall(gym.Env):
    """Two states of an affine model, one measurement, and a second that goes missing; nothing is random."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.seen()

    def step(self, action):
        self.count += 1
        return self.seen()[0], 0.0, False, False, self.seen()[1]

    def seen(self):
        z = np.array([math.sin(self.count), math.cos(self.count)])
        valid = np.array([True, self.count % 3 != 1])
        return np.where(valid, z, 0.0).astype(np.float32), {"measurement": z, "measurement_valid": valid}


def affine():
    return random_affine(n=2, m=2, p=1, seed=3)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("form", ["estimate", "measurement+estimate", "belief"])
def test_around_an_env_it_gives_what_ours_gives(form):
    envs = [EstimateState(Wall(), filter=kind, observation=form, model=affine()) for kind in ("kf", Textbook)]
    seen = [[env.reset(seed=3)] + [env.step(np.array([0.5]))[::4] for _ in range(6)] for env in envs]
    for (ours, info), (theirs, other) in zip(*seen, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
        assert set(info) == set(other) and ours.shape == envs[0].observation_space.shape
        for name in ("estimate", "estimate_cov", "innovation", "innovation_cov"):
            np.testing.assert_allclose(info[name], other[name], rtol=1e-8, atol=1e-9)


def test_what_it_does_not_give_is_zero_or_nan_beside_an_env_and_copies_go_their_own_ways():
    env = EstimateState(gym.make("BowThruster-v0"), filter=f"{HERE}:Drawing", observation="belief")
    observation, info = env.reset(seed=4)
    assert (observation[2:] == 0).all() and np.isfinite(observation).all() and (observation[:2] != 0).all()
    for name, value, shape in (
        ("estimate_cov", 0.0, (2, 2)),
        ("innovation", np.nan, (1,)),
        ("innovation_cov", np.nan, (1, 1)),
    ):
        np.testing.assert_array_equal(info[name], np.full(shape, value))
    assert info["estimate_divergences"] == 0 and env.spec.to_json()
    np.testing.assert_array_equal(env.reset(seed=4)[0], observation)
    other = copy.deepcopy(env)
    action = np.array([1.0], dtype=np.float32)
    np.testing.assert_array_equal(env.step(action)[0], other.step(action)[0])
    envs = EstimateStates(gym.make_vec("BowThruster-v0", num_envs=2), filter=Drawing(), observation="belief")
    rows, _ = envs.reset(seed=3)
    np.testing.assert_array_equal(rows[1], observation)
    assert (envs.step(np.ones((2, 1), dtype=np.float32))[0][:, :2] != rows[:, :2]).all()


def test_an_object_is_kept_in_the_spec_but_not_as_text():
    env = EstimateState(gym.make("BowThruster-v0"), filter=Drawing())
    again = gym.make(env.spec)
    np.testing.assert_array_equal(env.reset(seed=2)[0], again.reset(seed=2)[0])
    with pytest.raises(TypeError, match="give its name or 'module:object' instead"):
        env.spec.to_json()
    with pytest.raises(ValueError, match="must have reset.* and step.* to run beside an env"):
        only = AtOnce()
        only.reset = None
        EstimateState(gym.make("BowThruster-v0"), filter=only)


@pytest.mark.parametrize(
    ("use", "rule"),
    [
        (lambda one: one.set_noise(process_noise_cov=np.eye(2)), "Q and R of the filter 'mine' cannot vary"),
        (lambda one: one.set_noise(measurement_noise_cov=[[1.0]]), "Q and R of the filter 'mine' cannot vary"),
        (lambda one: one.scale_process_noise(2.0), "Q and R of the filter 'mine' cannot vary"),
        (lambda one: one.set_dt(0.1), "dt of the estimator 'mine' cannot vary from step to step"),
        (lambda one: one.set_parameter("gain", 2.0), "gain of the estimator 'mine' cannot vary"),
    ],
)
def test_a_session_refuses_what_an_estimator_cannot_be_set_to(use, rule):
    session = make_filter(Scripted(name="mine"), random_affine(2, 1, 1)).session()
    session.start((1, 2), [0.0])
    refused(rule, use, session)
    session.set_noise()
    session.scale_process_noise(1.0)
    session.step([0.0], [0.0])  # and nothing has changed


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


class DrawnAtOnce(Estimator):
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
    filter_ = make_filter(DrawnAtOnce(model.n, draw), model)
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
    refused(rule, run, filter_, KEYS, inputs, measurements)
