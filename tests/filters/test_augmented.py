"""Models made of models: joint estimation of parameters, fewer states within more, logarithms and logits."""

import math
import pickle

import numpy as np
import pytest

from filters import (
    ExtendedKalmanFilter,
    StateSpaceModel,
    Unknown,
    augmented_model,
    make_filter,
    run,
    thruster_model,
    transformed_model,
)
from filters.augmented import embedded_model
from tests.filters.checks import refused
from tests.models import KEY, held_voltages, scalar_model, simulated, state_space, wide_model
from tests.oracles import each_close
from thruster_env.core.compiled import interpreted
from thruster_env.core.derivatives import jacobian
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate


def test_the_new_states_stand_in_for_the_constants():
    model = thruster_model(preset="tunnel_physical", ambient_velocity=0.3)
    parameters = {
        "ambient_velocity": Unknown(0.5, walk_std=0.01, unit="m/s"),
        "load_gain": Unknown(1e3, mean=17e3),
    }
    augmented = augmented_model(model, parameters)
    assert (augmented.n, augmented.m, augmented.inputs) == (4, 1, 1)
    assert [state.short_label for state in augmented.states[2:]] == ["ambient_velocity [m/s]", "load_gain"]
    np.testing.assert_array_equal(augmented.prior_mean, [*model.prior_mean, 0.3, 17e3])
    np.testing.assert_allclose(np.diag(augmented.prior_cov)[2:], [0.25, 1e6])
    np.testing.assert_allclose(np.diag(augmented.process_noise_cov)[2:], [1e-4, 0.0])
    np.testing.assert_array_equal(augmented.process_noise_cov[:2, :2], model.process_noise_cov)
    np.testing.assert_allclose(augmented.state_high, [*model.state_high, 0.3 + 2 * math.hypot(0.5, 0.01), 19e3])

    x, u = (80.0, 1.0), (6.0,)
    constants = model.constants._replace(ambient_velocity=-0.2, load_gain=16e3)
    found = augmented.transition((*x, -0.2, 16e3), u, augmented.constants)
    np.testing.assert_allclose(found, [*model.transition(x, u, constants), -0.2, 16e3], rtol=1e-14)
    seen = augmented.observe((*x, -0.2, 16e3), augmented.constants)
    np.testing.assert_allclose(seen, model.observe(x, constants), rtol=1e-14)


def test_it_has_the_models_outputs():
    """Thrust of states and a constant that differ from row to row, as the model with that constant has it."""
    model = thruster_model(preset="tunnel_physical")
    augmented = pickle.loads(pickle.dumps(augmented_model(model, {"thrust_30": Unknown(1e-6)})))
    assert augmented.outputs.keys() == model.outputs.keys() == {"T"}
    factors = model.constants.thrust_30 * np.array([1.0, 1.2, 0.8])
    states = np.column_stack([[80.0, 80.0, -60.0], [1.0, 1.0, -0.5], factors])
    there = [model.replace(constants=model.constants._replace(thrust_30=factor)) for factor in factors]
    expected = [one.output("T", x) for one, x in zip(there, states[:, :2], strict=True)]
    np.testing.assert_allclose(augmented.output("T", states), expected, rtol=1e-14)
    assert expected[0] != pytest.approx(expected[1], rel=0.01)  # the constant counts


def test_its_jacobians_are_those_of_its_functions():
    model = thruster_model(preset="tunnel_physical")
    augmented = augmented_model(
        model, {"load_gain": Unknown(2e3), "thrust_30": Unknown(1e-6), "ambient_velocity": Unknown(0.3)}
    )
    x, u, c = (90.0, 1.1, 16e3, 9e-6, 0.0), (6.0,), augmented.constants
    scales = tuple(augmented.scales)
    for function, analytic, arguments, rows in (
        (augmented.transition, augmented.transition_jacobian, ("u, c", u, c), 5),
        (augmented.observe, augmented.observe_jacobian, ("c", c), 1),
    ):
        names, *values = arguments
        expected = jacobian(function, None, rows, 5, names)(x, scales, *values)
        np.testing.assert_allclose(analytic(x, *values), expected, rtol=1e-6, atol=1e-9)


def test_a_model_without_jacobians_gets_none():
    model = thruster_model().replace(transition_jacobian=None, observe_jacobian=None)
    augmented = augmented_model(model, {"motor_damping": Unknown(5.0)})
    assert augmented.transition_jacobian is None and augmented.observe_jacobian is None


def test_constants_of_a_tuple_go_by_number():
    model = scalar_model()
    augmented = augmented_model(model, {0: Unknown(0.1)})
    assert augmented.transition((2.0, 0.7), (0.5,), augmented.constants) == (0.7 * 2.0 + 0.5, 0.7)
    assert augmented.observe((2.0, 0.7), augmented.constants) == (4.0,)
    with interpreted():
        belief = ExtendedKalmanFilter(model=augmented).init()
    assert belief.mean.tolist() == [3.0, 0.9]


def test_it_recovers_the_load_gain_of_the_physical_tunnel():
    runs, plant = 40, thruster_model(preset="tunnel_physical")
    actual = plant.constants.load_gain
    inputs = held_voltages(runs, 30)
    drawn = simulate.simulate(plant, episode_keys(range(runs)), inputs)
    assumed = plant.replace(constants=plant.constants._replace(load_gain=0.7 * actual))
    joint = augmented_model(assumed, {"load_gain": Unknown(std=0.5 * actual)})
    found = run(ExtendedKalmanFilter(model=joint), np.zeros((runs, 2)), inputs, drawn.measurements)
    errors = found.means[:, -1, 2] - actual
    assert abs(errors.mean()) < 1.96 * errors.std(ddof=1) / math.sqrt(runs)
    assert errors.std() < 0.1 * actual
    np.testing.assert_allclose(np.sqrt(found.covs[:, -1, 2, 2]).mean(), errors.std(), rtol=0.4)
    plain = run(ExtendedKalmanFilter(model=assumed), np.zeros((runs, 2)), inputs, drawn.measurements)
    squares = [((e.means[..., :2] - drawn.states)[:, 50:] ** 2).mean(axis=1) for e in (plain, found)]
    gain = squares[0] - squares[1]
    assert (gain.mean(axis=0) > 1.96 * gain.std(axis=0, ddof=1) / math.sqrt(runs)).all()


@pytest.mark.parametrize(
    ("parameters", "rule"),
    [
        (
            {"viscosity": Unknown(1.0)},
            "a parameter must be one of the model's constants motor_damping, .* but got",
        ),
        ({}, "parameters must name at least one constant, but got none"),
        ({"load_gain": Unknown(0.0)}, "std of load_gain must be positive, but got 0.0"),
        (
            {"load_gain": Unknown(1.0, walk_std=-1.0)},
            "walk_std of load_gain must be zero or positive, but got -1.0",
        ),
        ({"load_gain": Unknown(1.0, mean=math.inf)}, "mean of load_gain must be a finite number, but got inf"),
    ],
)
def test_what_makes_no_sense_is_refused(parameters, rule):
    refused(rule, augmented_model, thruster_model(), parameters)


def pushed(x, u, c):
    return [x[i] + 0.1 * x[i - 1] ** 2 for i in range(len(x))]


def pushed_slopes(x, u, c):
    found = np.eye(len(x))
    for i in range(len(x)):
        found[i, i - 1] += 0.2 * x[i - 1]
    return found


def corner(x, c):
    return (x[0] * x[1],)


def corner_slopes(x, c):
    return (tuple(float(x[1 - i]) if i < 2 else 0.0 for i in range(len(x))),)


@pytest.mark.parametrize("n", [3, 7, 40])
def test_slopes_within_a_larger_model_are_those_of_its_functions(n):
    """In tuples, in arrays, and of tuples within arrays; also after pickle."""

    def model(size, names):
        return StateSpaceModel(
            transition=pushed,
            observe=corner,
            transition_jacobian=pushed_slopes,
            observe_jacobian=corner_slopes,
            process_noise_cov=np.full(size, 0.1),
            measurement_noise_cov=[1.0],
            prior_mean=np.linspace(1.0, 2.0, size),
            prior_cov=np.full(size, 0.1),
            states=names,
        )

    names = [f"s{i}" for i in range(n)]
    small, whole = model(n - 1, names[:0:-1]), model(n, names)
    one = pickle.loads(pickle.dumps(embedded_model(small, whole)))
    x = np.random.default_rng(n).normal(size=n)
    with interpreted():
        given = (tuple(x) if n <= 36 else x), (0.0,), ()
        np.testing.assert_allclose(one.functions.transition(*given)[0], x[0])
        np.testing.assert_allclose(one.functions.transition(*given)[1:], pushed(x[:0:-1], (), ())[::-1])
        f, h = np.zeros((n, n)), np.zeros((1, n))
        f[0, 0], f[1:, 1:], h[0, 1:] = (
            1.0,
            pushed_slopes(x[:0:-1], (), ())[::-1, ::-1],
            corner_slopes(x[:0:-1], ())[0][::-1],
        )
        np.testing.assert_allclose(one.functions.transition_jacobian(*given), f)
        np.testing.assert_allclose(one.functions.observe_jacobian(given[0], ()), h)


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
    each_close((model.output("c", s), model.output("y", s)), ([0.2, 1.0], [0.25, 0.5]))
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
    refused("a model is transformed by bounds of its states, but it has none", transformed_model, tank(bounds=()))
    with interpreted(), pytest.raises(ValueError, match="bounds must be of states c, y"):
        transformed_model(tank(), {"z": (0.0, None)})
