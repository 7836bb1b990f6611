"""Joint estimation of state and parameters: the augmented model, and that it recovers what is not known."""

import math
import pickle

import numpy as np
import pytest

from filters import (
    EnsembleKalmanFilter,
    ExtendedKalmanFilter,
    ParticleFilter,
    Unknown,
    augmented_model,
    run,
    thruster_model,
)
from tests.models import held_voltages, scalar_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.derivatives import jacobian
from thruster_env.core.streams import episode_keys, filter_keys
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


@pytest.mark.slow
def test_it_recovers_an_unknown_ambient_flow_and_beats_the_filter_that_ignores_it():
    runs, actual = 40, 0.6
    inputs = held_voltages(runs, 30)
    drawn = simulate.simulate(thruster_model(ambient_velocity=actual), episode_keys(range(runs)), inputs)
    assumed = thruster_model()  # still water

    def estimates(kind, model, **numbers):
        found = run(kind(model=model, **numbers), filter_keys(range(runs)), inputs, drawn.measurements)
        assert (found.divergences == 0).all()
        return found, ((found.means[..., :2] - drawn.states)[:, 50:] ** 2).mean(axis=1)

    _, plain = estimates(ExtendedKalmanFilter, assumed)
    joint = augmented_model(assumed, {"ambient_velocity": Unknown(std=0.5)})
    found, squares = estimates(ExtendedKalmanFilter, joint)
    gain = plain - squares  # paired by run; 95 % in each state
    assert (gain.mean(axis=0) > 1.96 * gain.std(axis=0, ddof=1) / math.sqrt(runs)).all()
    assert squares[:, 1].mean() < 0.5 * plain[:, 1].mean()
    flow, spread = found.means[:, -1, 2], np.sqrt(found.covs[:, -1, 2, 2])
    assert abs(flow.mean() - actual) < 0.02 and (spread < 0.1).all()
    for kind, size in ((EnsembleKalmanFilter, 100), (ParticleFilter, 1000)):
        found, _ = estimates(kind, joint, ensemble_size=size)
        assert abs(found.means[:, -1, 2].mean() - actual) < 0.05


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
    with pytest.raises(ValueError, match=rule):
        augmented_model(thruster_model(), parameters)
