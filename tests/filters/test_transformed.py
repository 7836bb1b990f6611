"""States with bounds as logarithms and logits: by hand, positive throughout, coverage of what is drawn."""

import math
import pickle

import numpy as np
import pytest

from filters import StateSpaceModel, make_filter, run, transformed_model
from filters.augmented import Unknown, augmented_model
from tests.models import KEY, simulated, state_space, wide_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate

RATE, INFLOW = 0.1, 0.05  # of a stirred tank [1/step], [mol/l/step]


def decay(x, u, c):
    """Concentration [mol/l] and conversion [1] of a tank."""
    return (x[0] + INFLOW * u[0] - RATE * x[0], x[1] + 0.1 * x[0] * (1.0 - x[1]) - 0.05 * x[1])


def sample(x, c):
    return (x[0], x[1])


def total(x, c):
    return x[0] + 2.0 * x[1]


def tank(**changes):
    arguments = {
        "transition": decay,
        "observe": sample,
        "process_noise_cov": [[4e-4, 1e-4], [1e-4, 9e-4]],
        "measurement_noise_cov": [0.09, 0.04],
        "prior_mean": [0.5, 0.4],
        "prior_cov": [0.04, 0.01],
        "inputs": 1,
        "states": [("concentration", "c", "mol/l"), ("conversion", "y", "")],
        "outputs": {"s": (("total", "s", "mol/l"), total)},
        "bounds": {"c": (0.0, None), "y": (0.0, 1.0)},
    }
    return StateSpaceModel(**{**arguments, **changes})


def decay_by_hand(s, u, c):
    c_next, y_next = decay((math.exp(s[0]), 1.0 / (1.0 + math.exp(-s[1]))), u, c)
    return (math.log(c_next), math.log(y_next / (1.0 - y_next)))


def sample_by_hand(s, c):
    return (math.exp(s[0]), 1.0 / (1.0 + math.exp(-s[1])))


@pytest.mark.parametrize("name", ["ekf", "ukf", "enkf", "pf"])
@pytest.mark.usefixtures("as_python")
def test_it_is_what_one_writes_by_hand(name):
    model = transformed_model(tank())
    slopes = np.diag([1 / 0.5, 1 / 0.4 + 1 / 0.6])
    noise = {"q": slopes @ tank().process_noise_cov @ slopes, "r": [0.09, 0.04]}
    prior = {"mean": [math.log(0.5), math.log(0.4 / 0.6)], "cov": slopes @ tank().prior_cov @ slopes}
    by_hand = state_space(decay_by_hand, sample_by_hand, **noise, **prior, inputs=1)
    numbers = {"ensemble_size": 30} if name in ("enkf", "pf") else {}
    inputs, z = np.full((1, 20, 1), 0.7), 0.4 + np.random.default_rng(1).normal(size=(1, 21, 2)) * 0.2
    one, other = (run(make_filter(name, it, **numbers), np.array([KEY]), inputs, z) for it in (model, by_hand))
    np.testing.assert_allclose(one.means, other.means, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(one.covs, other.covs, rtol=1e-8, atol=1e-10)
    assert [state.symbol for state in model.states] == ["log_c", "logit_y"] and model.bounds == ()


def test_the_states_and_what_follows_from_them_are_outputs():
    model = pickle.loads(pickle.dumps(transformed_model(tank())))
    s = np.array([[math.log(0.2), math.log(0.25 / 0.75)], [0.0, 0.0]])
    np.testing.assert_allclose(model.output("c", s), [0.2, 1.0])
    np.testing.assert_allclose(model.output("y", s), [0.25, 0.5])
    np.testing.assert_allclose(model.output("s", s), [0.7, 2.0])
    assert model.outputs["c"].quantity == tank().states[0]


def test_a_bound_from_above_and_states_without_one():
    model = transformed_model(tank(bounds={"c": (None, 3.0)}, prior_mean=[2.0, 0.4]))
    assert [state.symbol for state in model.states] == ["log_c", "y"]
    np.testing.assert_allclose(model.prior_mean, [-math.log(1.0), 0.4])
    np.testing.assert_allclose(model.prior_cov, [[0.04, 0.0], [0.0, 0.01]])
    np.testing.assert_allclose(model.observe((-5.0, 0.1), ()), [3.0 - math.exp(5.0), 0.1])
    np.testing.assert_allclose(model.observe((50.0, 0.1), ()), [3.0, 0.1])  # never beyond
    partly = transformed_model(tank(), {"c": (0.0, None)})
    assert partly.bounds == ((1, 0.0, 1.0),)  # which filters keep in the other way


@pytest.mark.usefixtures("as_python")
def test_what_it_says_of_positive_states_is_true_as_often_as_it_says():
    """Of runs of the model itself 95 % of the states lie in intervals of 95 %: of logarithms, and so of states."""
    thin = tank(prior_mean=[0.15, 0.4], prior_cov=[0.01, 0.01])
    model = transformed_model(thin)
    count, steps = 120, 50
    inputs = np.zeros((count, steps, 1))
    drawn = simulate.simulate(model, episode_keys(range(count)), inputs)
    found = run(make_filter("ukf", model), None, inputs, drawn.measurements)
    deviations = np.sqrt(np.einsum("bkii->bki", found.covs))
    inside = abs(found.means - drawn.states) < 1.96 * deviations
    by_run = inside[:, 10:].mean(axis=1)
    share, error = by_run.mean(axis=0), by_run.std(axis=0) / np.sqrt(count)
    assert (abs(share - 0.95) < 3.0 * error + 0.01).all()
    states = [model.output(symbol, found.means) for symbol in ("c", "y")]
    assert states[0].min() > 0.0 and states[1].min() > 0.0 and states[1].max() < 1.0
    plain = run(make_filter("ukf", thin.replace(bounds=())), None, inputs, drawn.measurements)
    assert plain.means[:, :, 0].min() < 0.0  # what it is for


@pytest.mark.usefixtures("as_python")
def test_many_states_and_unknown_constants_can_be_transformed():
    n = 40
    model = StateSpaceModel(
        transition=lambda x, u, c: tuple(0.9 * x[i] + 0.1 for i in range(n)),
        observe=lambda x, c: (x[0], x[39]),
        process_noise_cov=[0.01] * n,
        measurement_noise_cov=[0.1, 0.1],
        prior_mean=[1.0] * n,
        prior_cov=[0.1] * n,
        inputs=0,
    )
    large = transformed_model(model, {39: (0.0, None)})
    found = run(make_filter("ekf", large), None, None, np.full((1, 5, 2), 1.3))
    assert np.isfinite(found.means).all() and (found.means[0, -1, 39] > 0.0)
    joint = augmented_model(wide_model(), {0: Unknown(0.2)})
    positive = transformed_model(joint, {3: (0.0, None)})
    inputs, z = simulated(wide_model(), 10)
    assert np.isfinite(run(make_filter("ekf", positive), None, inputs, z).means).all()


def test_what_it_cannot_transform_is_refused():
    with pytest.raises(ValueError, match="prior_mean of c must be within its bounds, but got 0.5"):
        transformed_model(tank(), {"c": (0.6, None)})
    with pytest.raises(ValueError, match="a model is transformed by bounds of its states, but it has none"):
        transformed_model(tank(bounds=()))
    with interpreted(), pytest.raises(ValueError, match="bounds must be of states c, y"):
        transformed_model(tank(), {"z": (0.0, None)})
