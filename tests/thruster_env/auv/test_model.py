import pickle

import numpy as np
import pytest
from scipy.linalg import expm

from filters import FILTERS, make_filter
from filters.registry import filter_type
from tests.thruster_env.auv.textbook import random_states
from thruster_env.auv import dynamics
from thruster_env.auv.model import MODEL_ARGUMENTS, MODELS, auv_model, continuous_auv, model_of_plant
from thruster_env.auv.parameters import SEGOROGENI, derive_constants
from thruster_env.auv.plant import make_plant
from thruster_env.model.affine import linearize

SENSORS = {"velocities": "papers", "motion": "motion", "navigation": "usbl", "current": "usbl"}


def given(model, seed=0):
    """A state and an input of a model, and the equations' own four inputs with the attitude."""
    x, u = random_states(1, seed)
    x, u = x[0], u[0]
    inputs = [
        u[{"X_prop": 0, "K_prop": 1, "delta_s": 2, "delta_r": 3}.get(one.symbol, 1)]
        for one in model.input_quantities
    ]
    return tuple(x[: model.n].tolist()), tuple(inputs), u


@pytest.mark.parametrize(
    "states, step", [("motion", dynamics.motion_substep), ("navigation", dynamics.navigation_substep)]
)
@pytest.mark.parametrize("torque", [-0.006, None])
def test_a_model_moves_as_the_equations_do(states, step, torque):
    model = auv_model(states=states, propeller_torque=torque)
    x, inputs, u = given(model)
    k_prop = u[1] if torque is None else torque * u[0]
    c = derive_constants(SEGOROGENI, 0.05)
    expected = step(x, (u[0], k_prop, u[2], u[3]), c)
    np.testing.assert_allclose(model.transition(x, inputs, model.constants), expected, rtol=1e-15)
    assert model.transition_jacobian(x, inputs, model.constants).shape == (model.n, model.n)


def test_six_velocities_get_roll_and_pitch_as_inputs_or_are_level():
    told = auv_model(states="velocities")
    assert [one.symbol for one in told.input_quantities] == ["X_prop", "delta_s", "delta_r", "phi", "theta"]
    x, c = (1.0, 0.1, 0.0, 0.0, 0.1, 0.1), told.constants
    motion = auv_model(states="motion")
    expected = motion.transition((*x, 0.1, -0.2), (3.0, 0.1, 0.0), motion.constants)
    pitched = told.transition(x, (3.0, 0.1, 0.0, 0.1, -0.2), c)
    np.testing.assert_allclose(pitched, expected[:6], atol=6e-3)  # the angles move meanwhile
    level = auv_model(states="velocities", attitude="level")
    assert level.inputs == 3
    assert level.transition(x, (3.0, 0.1, 0.0), c) == told.transition(x, (3.0, 0.1, 0.0, 0.0, 0.0), c) != pitched


def test_a_current_among_the_states_is_what_the_vehicle_goes_in():
    model = auv_model(states="current")
    navigation = auv_model(states="navigation")
    x, u, c = (1.0, 0.1, -0.1, 0.1, -0.1, 0.1, 0.1, -0.2, 0.7, 3.0, -2.0, 5.0), (3.0, 0.1, -0.1), model.constants
    still = model.transition((*x, 0.0, 0.0), u, c)
    np.testing.assert_allclose(still, (*navigation.transition(x, u, c), 0.0, 0.0), rtol=1e-13)
    drifting = (*x, 0.3, -0.2)
    moved = dynamics.current_substep(
        x, (3.0, -0.006 * 3.0, 0.1, -0.1, 0.3, -0.2, 0.0), derive_constants(SEGOROGENI, 0.05)
    )
    np.testing.assert_allclose(model.transition(drifting, u, c), (*moved, 0.3, -0.2), rtol=1e-13)
    slopes = linearize(model.replace(transition_jacobian=None), drifting, u).matrices()[0]
    np.testing.assert_allclose(model.transition_jacobian(drifting, u, c), slopes, atol=1e-8)


def test_a_current_wanders_as_much_as_one_of_its_standard_deviation_and_time():
    model = auv_model(states="current", current_std=0.3, current_time=100.0)
    np.testing.assert_allclose(np.diag(model.process_noise_cov)[12:], 2 * 0.3**2 * 0.05 / 100.0)
    np.testing.assert_allclose(np.diag(model.prior_cov)[12:], 0.3**2)
    for name in ("current_std", "current_time"):
        with pytest.raises(ValueError, match=f"{name} must be positive"):
            auv_model(states="current", **{name: 0.0})


def test_the_papers_integrate_by_euler():
    model = auv_model(states="velocities", sensors="papers", integration="euler", dt=0.001, propeller_torque=None)
    x, u = (1.0, 0.1, 0.0, 0.0, 0.1, 0.1), (3.0, 0.0, 0.1, 0.05, 0.0, 0.0)
    c = model.constants
    expected = np.array(x) + 0.001 * np.array(dynamics.velocity_rates(x, u, c))
    np.testing.assert_allclose(model.transition(x, u, c), expected, rtol=1e-15)
    slopes = linearize(model.replace(transition_jacobian=None), x, u).matrices()[0]
    np.testing.assert_allclose(model.transition_jacobian(x, u, c), slopes, atol=1e-8)


def test_models_name_what_they_are_made_of():
    for states, steps in MODELS.items():
        model, count = auv_model(states=states), steps.count
        assert (model.n, len(model.states)) == (count, count)
        assert [one.symbol for one in model.states if one.angle] == ["psi"] * (count >= 12)
        assert tuple(model.outputs) == (("U",) if count == 6 else ("U", "z_dot", "psi_dot"))
        assert (model.state_low < model.state_high).all() and model.state_low[0] == 0.0
        np.testing.assert_array_equal(model.operating_state, np.eye(count)[0])
        assert model.operating_input[0] == pytest.approx(2.845, abs=1e-3)
        assert pickle.loads(pickle.dumps(model)).digest == model.digest
    assert auv_model().m == 8 and auv_model(states="velocities").m == 6 and auv_model(states="navigation").m == 10
    assert auv_model(propeller_torque=None).operating_input[1] == 0.0


def test_the_smallest_closed_model_that_predicts_the_sensors_is_taken():
    assert auv_model(sensors=["u", "theta"]).n == auv_model(sensors="papers").n == 8
    assert auv_model(sensors=["u", "z"]).n == auv_model(sensors="default").n == 12
    assert model_of_plant(make_plant()).n == 12


def test_outputs_follow_from_states():
    model, path = auv_model(states="navigation"), np.array([[1.0, 0, 0, 0, 0, 0.1, 0, -0.3, 0.5, 0, 0, 0]] * 2)
    np.testing.assert_allclose(model.output("U", path), 1.0)
    np.testing.assert_allclose(model.output("z_dot", path), np.sin(0.3))
    np.testing.assert_allclose(model.output("psi_dot", path), 0.1 / np.cos(0.3))


def test_a_filter_may_assume_another_vehicle_and_other_noise():
    model = auv_model(
        parameter_factors={"Xuu": 2.0},
        process_noise_cov=[1e-4] * 8,
        measurement_noise_cov=[1e-2] * 8,
        prior_cov_factor=4.0,
        operating_speed=0.5,
    )
    assert model.constants.x_uu == 2.0 * SEGOROGENI.Xuu
    assert model.operating_input[0] == pytest.approx(2 * 2.845 / 4, abs=1e-3)
    assert (np.diag(model.process_noise_cov) == 1e-4).all() and (
        np.diag(model.measurement_noise_cov) == 1e-2
    ).all()
    np.testing.assert_allclose(model.prior_cov, 4.0 * auv_model().prior_cov)
    assert set(MODEL_ARGUMENTS) >= {"states", "integration", "process_noise_cov", "prior_cov_factor"}


@pytest.mark.parametrize(
    "arguments, message",
    [
        (
            {"states": "motion", "sensors": ["u", "z"]},
            "sensors of a model of 8 states must measure u, v, w, p, q, r, phi, theta, but got z",
        ),
        (
            {"states": "velocities", "sensors": ["phi"]},
            "sensors of a model of 6 states must measure u, v, w, p, q, r, ",
        ),
        ({"states": "pose"}, "states must be one of velocities, motion, navigation, current, but got 'pose'"),
        ({"integration": "heun"}, "integration must be one of runge-kutta, euler, but got 'heun'"),
        ({"attitude": "steep"}, "attitude must be one of input, measured, level, but got 'steep'"),
        ({"parameter_factors": {"drag": 2}}, "parameter_factors must name fields of m, W, B"),
        ({"parameter_factors": {"Xuu": 0}}, "Xuu must be positive, but got 0"),
        ({"operating_speed": 0}, "operating_speed must be positive, but got 0"),
        ({"process_noise_cov": [1e-6] * 12}, "process_noise_cov must be 8 variances or a symmetric 8 x 8 matrix"),
    ],
)
def test_what_makes_no_model_is_told_in_a_line(arguments, message):
    with pytest.raises(ValueError) as error:
        auv_model(**arguments)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("states", MODELS)
def test_every_filter_runs(states):
    """Interpreted, one step each, on other states one of each kind; fuzzy rules for speed and rates of turn."""
    model = auv_model(states=states, sensors=SENSORS[states])
    u, z = (
        np.array(model.operating_input),
        np.array(model.observe(tuple(model.prior_mean.tolist()), model.constants)),
    )
    for name in FILTERS if states == "motion" else ("kf", "ekf", "ukf", "vb", "enkf", "ensrf", "pf"):
        numbers = {"ensemble_size": 10} if filter_type(name).has_ensemble else {}
        numbers |= {"premises": [0, 4, 5]} if name == "fuzzy" else {}
        filter_ = make_filter(name, model, **numbers)
        belief = filter_.predict(filter_.init(), u)
        belief, innovation = filter_.update(belief, z + 0.01)
        assert np.isfinite(belief.mean).all(), name
        assert abs(belief.mean[0] - 1.0) < 0.2 and belief.divergences == 0, name


def test_the_fuzzy_filter_has_a_rule_for_each_corner_of_eight_states():
    fuzzy = make_filter("fuzzy", auv_model(sensors="papers"))
    assert fuzzy.premises == tuple(range(8))
    with pytest.raises(ValueError, match="premises must name 1 to 8 different states"):
        make_filter("fuzzy", auv_model(states="navigation"))


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"states": "velocities"},
        {"states": "velocities", "attitude": "level"},
        {"states": "velocities", "attitude": "measured"},
        {"states": "navigation"},
        {"states": "current", "dt": 0.1},
        {"propeller_torque": None},
    ],
)
def test_at_its_sample_time_it_is_the_discrete_model(arguments):
    model, plant = auv_model(**arguments), continuous_auv(**arguments)
    made = plant.at(arguments.get("dt", 0.05))
    assert made.digest == model.digest
    assert (made.constants, made.substeps) == (model.constants, model.substeps)
    np.testing.assert_allclose(made.process_noise_cov, model.process_noise_cov, rtol=1e-10, atol=1e-16)


def test_two_half_steps_are_a_whole_one_in_mean_and_noise():
    """A linear system's Q of a step is F Q_half F' + Q_half of two halves."""
    plant = continuous_auv(states="navigation")
    half, whole = plant.at(0.025), plant.at(0.05)
    x, u, c = tuple(plant.point[0]), tuple(plant.point[1]), half.constants
    middle = half.transition(x, u, c)
    np.testing.assert_allclose(
        half.transition(middle, u, c), whole.transition(x, u, whole.constants), rtol=1e-3, atol=2e-7
    )
    f, q = expm(0.025 * plant.slope), half.process_noise_cov
    np.testing.assert_allclose(f @ q @ f.T + q, whole.process_noise_cov, rtol=1e-8, atol=1e-14)


def test_a_model_of_other_rates_is_refused():
    with pytest.raises(ValueError, match="rates must be those of the model, whose step from"):
        continuous_auv(integration="euler")
