"""A belief belongs to a kind of filter and a model; another one's is refused in one line."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import pytest

from filters import affine_model, make_filter, thruster_model
from filters.engine.session import Session
from tests.filters.checks import refused
from tests.models import affine, state_space
from tests.oracles import each_equal

pytestmark = pytest.mark.usefixtures("as_python")


def of_three_states():
    return affine(
        0.9 * np.eye(3), np.ones((3, 1)), [[1.0, 0.0, 0.0]], q=[0.1] * 3, r=[0.2], mean=[0.0] * 3, cov=[1.0] * 3
    )


def made(name, model=thruster_model, **numbers):
    return make_filter(name, model(), **numbers)


@pytest.mark.parametrize(
    ("filter_", "other", "rule"),
    [
        (made("ekf"), made("enkf", ensemble_size=9), r"members of .* 'ekf' .* shape \(2, 0\), but got \(2, 9\)"),
        (made("enkf"), made("ekf"), r"members of .* 'enkf' .* shape \(2, 100\), but got \(2, 0\)"),
        (made("enkf", ensemble_size=9), made("etkf", ensemble_size=1 + 9), r"\(2, 9\), but got \(2, 10\)"),
        (made("enkf", ensemble_size=9), made("pf", ensemble_size=9), r"\(2, 9\), but got \(3, 9\)"),
        (made("pf", ensemble_size=9), made("enkf", ensemble_size=9), r"\(3, 9\), but got \(2, 9\)"),
        (made("vb"), made("ekf"), r"extras of .* 'vb' .* shape \(2,\), but got \(0,\)"),
        (made("ekf"), made("vb"), r"extras of .* 'ekf' .* shape \(0,\), but got \(2,\)"),
        (made("ekf"), made("ekf", of_three_states), r"mean of .* 'ekf' .* shape \(2,\), but got \(3,\)"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_belief_of_another_filter_is_refused(filter_, other, rule):
    belief = other.init((1, 2))
    for use in (lambda: filter_.predict(belief, [1.0]), lambda: filter_.update(belief, [1.0])):
        refused(rule, use)


def test_a_session_goes_on_from_a_belief_of_its_own_filter():
    filter_ = made("pf", ensemble_size=9)
    belief, _ = filter_.update(filter_.init((1, 2)), [3.0])
    session = Session(filter_)
    session.load(belief)
    session.step([5.0], [4.0])
    expected, _ = filter_.update(filter_.predict(belief, [5.0]), [4.0])
    np.testing.assert_array_equal(session.belief().members, expected.members)


class Timed(NamedTuple):
    """Constants of a model whose sample time may vary."""

    dt: float
    drag: float


def roll(x, u, c):
    return x[0] + c.dt * x[1], x[1] + c.dt * (u[0] - c.drag * x[1])


def look(x, c):
    return x[0], x[1]


def cart(dt=0.1, q=0.01):
    return state_space(
        roll, look, q=[q, q], r=[0.04, 0.09], mean=[0.0, 0.0], cov=[1.0, 1.0], inputs=1, constants=Timed(dt, 0.3)
    )


@pytest.mark.parametrize("name", ["ekf", "enkf", "pf", "ukf"])
def test_the_pure_functions_take_no_root_of_a_covariance_and_no_new_memory_at_each_call(name, monkeypatch):
    filter_ = make_filter(name, cart(), **({"ensemble_size": 9} if name in ("enkf", "pf") else {}))
    belief, _ = filter_.update(filter_.init((1, 2)), [0.1, 0.0])

    def never(*arguments):
        raise AssertionError("this takes longer than a step")

    monkeypatch.setattr("thruster_env.model.state_space.covariance_root", never)
    monkeypatch.setattr("filters.engine.session.new_memory", never)
    belief = filter_.predict(belief, [1.0])
    belief, innovation = filter_.update(belief, [0.2, np.nan])
    assert belief.step == 1 and np.isfinite(innovation.log_likelihood)


@pytest.mark.parametrize("name", ["ekf", "enkf", "pf", "sage-husa"])
def test_what_was_done_before_with_a_filter_changes_no_later_result(name):
    filter_, fresh = (made(name) for _ in range(2))
    start, _ = filter_.update(filter_.init((1, 2)), [3.0])
    expected = fresh.update(fresh.predict(start, [5.0]), [4.0])
    other = filter_.init((9, 9))
    for _ in range(3):
        other = filter_.update(filter_.predict(other, [-20.0]), [1.0])[0]
    if filter_.varying_noise:
        filter_.predict(other, [1.0], process_noise_cov=[7.0, 7.0])
        filter_.update(other, [1.0], measurement_noise_cov=[7.0])
    refused("u must be 1 number", filter_.predict, start, [np.nan])
    found = filter_.update(filter_.predict(start, [5.0]), [4.0])
    each_equal((*found[0], *found[1]), (*expected[0], *expected[1]))
    copied = pickle.loads(pickle.dumps(filter_))
    assert not any(key.startswith("_spare") for key in vars(copied))
    np.testing.assert_array_equal(copied.predict(start, [5.0]).cov, fresh.predict(start, [5.0]).cov)


def test_a_belief_that_was_made_here_is_checked_once_it_was_written_to():
    filter_ = make_filter("ekf", thruster_model())
    belief = filter_.predict(filter_.init(), [3.0])
    after, _ = filter_.update(belief, [0.4])
    for copied in (belief._replace(step=belief.step), pickle.loads(pickle.dumps(belief)), copy.copy(belief)):
        np.testing.assert_array_equal(filter_.update(copied, [0.4])[0].mean, after.mean)
    other, _ = filter_.update(belief, [0.4], measurement_noise_cov=[9.0])
    assert other.mean[0] != after.mean[0]
    np.testing.assert_array_equal(filter_.update(belief, [0.4])[0].cov, after.cov)  # with R of the model again
    belief.mean[0] += 1.0
    assert filter_.update(belief, [0.4])[0].mean[0] != after.mean[0]
    belief.mean[0] = np.nan
    refused("mean of a belief must be finite", filter_.predict, belief, [3.0])
    refused("u must be 1 number", filter_.predict, after, [np.inf])
    assert repr(after).startswith("Belief(mean=")


def test_predict_and_update_of_a_session_are_its_step():
    first, second, third = (make_filter("ekf", thruster_model()).session() for _ in range(3))
    first.start((1, 2), [0.1])
    second.start((1, 2))
    second.update([0.1])
    for z in ([0.3], [np.nan]):
        first.step([3.0], z)
        second.predict([3.0])
        second.update(z)
    np.testing.assert_array_equal(first.mean, second.mean)
    refused("z must be 1 number, each finite or NaN, but got", second.update, [np.inf])
    for session in (third, copy.deepcopy(third), pickle.loads(pickle.dumps(made("ekf").session(gate=3.0)))):
        refused("a session must begin with start", session.step, [1.0], [1.0])


def test_threads_share_a_filter_and_not_its_memory():
    filter_ = made("ekf")
    start = filter_.init()

    def after(u):
        belief = start
        for _ in range(20):
            belief, _ = filter_.update(filter_.predict(belief, [u]), [0.1 * u])
        return belief.mean

    expected = [after(u) for u in range(8)]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(after, range(8)))
    np.testing.assert_array_equal(found, expected)


def test_numbers_follow_a_model_whose_arrays_are_written_to():
    model = cart()
    filter_ = make_filter("ekf", model)
    belief = filter_.predict(filter_.init(), [0.0])
    model.process_noise_cov[0, 0] += 5.0
    assert filter_.predict(filter_.init(), [0.0]).cov[0, 0] == pytest.approx(belief.cov[0, 0] + 5.0)


NO_COVARIANCE = {
    "negative": ([[1.0, 0.0], [0.0, -0.1]], "positive semidefinite"),
    "indefinite": ([[1.0, 2.0], [2.0, 1.0]], "positive semidefinite"),
    "lopsided": ([[1.0, 0.5], [0.1, 1.0]], "symmetric"),
    "NaN": ([[1.0, np.nan], [np.nan, 1.0]], "finite"),
    "infinite": ([[np.inf, 0.0], [0.0, 1.0]], "finite"),
}


@pytest.mark.parametrize(("cov", "rule"), NO_COVARIANCE.values(), ids=list(NO_COVARIANCE))
def test_a_quick_look_at_a_belief_lets_none_through_that_is_off(cov, rule):
    for count in (2, 7):  # few states are looked at in Python
        model = cart() if count == 2 else wide_identity(count)
        filter_ = make_filter("ekf", model)
        whole = np.eye(count)
        whole[:2, :2] = cov
        belief = filter_.init()._replace(cov=whole)
        refused(f"cov of a belief must be .*{rule}", filter_.predict, belief, [0.0])
        for good in (np.zeros((count, count)), np.ones((count, count)), np.diag([0.0] + [1.0] * (count - 1))):
            filter_.predict(belief._replace(cov=good), [0.0])
        with pytest.raises(ValueError, match="mean of a belief must be finite"):
            filter_.predict(belief._replace(cov=np.eye(count), mean=np.full(count, np.nan)), [0.0])


def wide_identity(n):
    return affine_model(
        a=0.9 * np.eye(n), b=np.ones((n, 1)), c=np.eye(1, n), process_noise_cov=[0.1] * n,
        measurement_noise_cov=[0.2], prior_mean=[0.0] * n, prior_cov=[1.0] * n,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["ekf", "enkf"])
def test_a_gate_leaves_out_channels_that_are_too_far(name):
    filter_ = make_filter(name, cart())
    session = filter_.session(gate=4.0)
    session.start((3, 4), [0.0, 0.0])
    belief, _ = filter_.update(filter_.init((3, 4)), [0.0, 0.0])
    for z, seen in (([0.1, 0.2], [0.1, 0.2]), ([50.0, 0.1], [np.nan, 0.1]), ([0.1, np.nan], [0.1, np.nan])):
        session.step([0.3], z)
        belief, innovation = filter_.update(filter_.predict(belief, [0.3]), seen)
        each_equal((session.mean, session.innovation), (belief.mean, innovation.value))
    assert session.rejected.tolist() == [1, 0]
    other = pickle.loads(pickle.dumps(session))
    for one in (session, other):
        one.step([0.3], [0.2, 80.0])
    np.testing.assert_array_equal(other.mean, session.mean)
    assert other.rejected.tolist() == [1, 1]
    follows = filter_.session(gate=4.0, most=2)
    follows.start((3, 4), [0.0, 0.0])
    for z in ([50.0, 0.1], [np.nan, 0.1], [50.0, 0.1], [50.0, 0.1]):
        follows.step([0.3], z)
    assert follows.rejected.tolist() == [2, 0] and abs(follows.mean[0]) > 5.0
    refused("gate must be positive, but got 0", filter_.session, gate=0.0)
    with pytest.raises(ValueError, match="a gate needs a filter with a covariance, but 'open-loop'"):
        make_filter("open-loop", cart()).session(gate=3.0)


def test_a_session_takes_another_sample_time_where_the_model_has_it():
    session = make_filter("ekf", cart()).session()
    session.start((0, 0), [0.0, 1.0])
    belief = session.belief()
    session.set_dt(0.25)
    session.step([2.0], [0.1, 0.9])
    other = make_filter("ekf", cart(dt=0.25))
    expected, _ = other.update(other.predict(belief, [2.0]), [0.1, 0.9])
    np.testing.assert_array_equal(session.mean, expected.mean)
    refused("dt must be .*positive", session.set_dt, -1.0)
    with pytest.raises(ValueError, match=r"a constant dt, but got none: write f\(x, u, c\) with c.dt"):
        made("ekf", of_three_states).session().set_dt(0.1)
