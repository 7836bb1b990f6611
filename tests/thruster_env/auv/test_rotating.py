"""The vehicle with a quaternion: the same motion as with roll, pitch and yaw, and a loop, where these end."""

import gymnasium as gym
import numpy as np
import pytest

import filters
import thruster_env  # noqa: F401, registers the envs
from thruster_env.auv.dynamics import ROTATING, angled_state, rotating_substep
from thruster_env.auv.equations import by_vectors, simulate
from thruster_env.auv.model import auv_model, continuous_auv
from thruster_env.auv.parameters import SEGOROGENI, derive_constants
from thruster_env.auv.paths import DepthAndCourse
from thruster_env.auv.plant import FIELD, make_plant, rotating_state
from thruster_env.core.streams import episode_keys
from thruster_env.model import rotations
from thruster_env.model.turns import difference

ATTITUDES = "euler", "quaternion"
STATE = (0.9, 0.05, -0.04, 0.1, -0.05, 0.08, 0.3, -0.4, 0.8, 1.0, -2.0, 3.0)
LOOP = [8.0, -np.radians(15.0), 0.0]  # full thrust, nose up
LOOPING = {"attitude": "quaternion", "sensors": "vectors", "max_thrust": 8.0}


def test_both_forms_of_a_state_are_one():
    np.testing.assert_allclose(angled_state(rotating_state(STATE)), STATE, atol=1e-15)
    attitude, velocity = rotating_state(STATE)[6:10], (1.0, 0.2, -0.3)
    *moving, yaw = by_vectors(
        *(rotations.to_body(attitude, direction) for direction in ((0.0, 0.0, 2.0), FIELD)), velocity
    )
    np.testing.assert_allclose(moving, rotations.to_world(attitude, velocity), atol=1e-15)
    assert yaw == pytest.approx(STATE[8], abs=1e-15)


def test_it_moves_and_measures_as_with_roll_pitch_and_yaw():
    """To 1e-9, in a current, from the same state, by the simulation of the env."""
    commands = np.random.default_rng(0).uniform([[0.0, -0.2, -0.2]], [[4.0, 0.2, 0.2]], (2, 20, 3))
    simulations = [
        simulate(
            make_plant(
                attitude=attitude,
                substeps=20,
                initial_state=STATE,
                process_noise_cov=[0.0] * 12,
                measurement_noise_cov=[0.0] * 10,
                current=(0.2, -0.1, 0.05),
            ),
            episode_keys((1, 2)),
            commands,
        )
        for attitude in ATTITUDES
    ]
    angles, quaternions = (simulation.states for simulation in simulations)
    np.testing.assert_allclose(
        np.moveaxis(angled_state(np.moveaxis(quaternions, -1, 0)), 0, -1), angles, atol=1e-9
    )
    np.testing.assert_allclose(simulations[1].measurements, simulations[0].measurements, atol=1e-9)


@pytest.mark.parametrize("states", ["motion", "navigation"])
def test_its_model_moves_and_measures_so_too(states):
    """At a sample time of which a step is exact to 1e-9; and in continuous time it is the same model."""
    models = [auv_model(states=states, attitude=attitude, dt=0.005) for attitude in ("input", "quaternion")]
    count = 8 if states == "motion" else 12
    u, angled = (3.0, 0.1, -0.05), STATE[:count]
    rotating = rotating_state(STATE)[: models[1].n]
    for _ in range(100):
        angled, rotating = (
            model.transition(x, u, model.constants) for model, x in zip(models, (angled, rotating), strict=True)
        )
    np.testing.assert_allclose(angled_state(rotating)[:count], angled, atol=1e-9)
    measured = models[1].observe(rotating, models[1].constants)
    symbols = [channel.symbol for channel in models[1].measurements]
    expected = [symbols.index(channel.symbol) for channel in models[0].measurements]
    np.testing.assert_allclose(np.array(measured)[expected], models[0].observe(angled, ()), atol=1e-9)
    assert (
        continuous_auv(states=states, attitude="quaternion").at(0.05).digest
        == auv_model(states=states, attitude="quaternion").digest
    )


def test_a_loop_passes_the_pitch_at_which_angles_end():
    """The env with angles terminates; with a quaternion the nose goes over, and the position is reckoned on."""
    env = gym.make("SegorogeniAUV-v0", **LOOPING)
    env.reset(seed=1)
    noses, states = [], []
    for _ in range(400):
        _, reward, terminated, _, info = env.step(LOOP)
        assert not terminated and np.isfinite(reward)
        states.append(info["state"])
        noses.append(rotations.to_world(info["state"][6:10], (1.0, 0.0, 0.0)))
    downs = [rotations.to_world(state[6:10], (0.0, 0.0, 1.0))[2] for state in states]
    assert np.min(noses, axis=0)[2] < -0.99 and min(downs) < -0.7  # straight up, then on its back
    np.testing.assert_allclose(np.linalg.norm(np.array(states)[:, 6:10], axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(info["reckoned"][:2], info["state"][10:12], atol=0.2)
    env.reset(options={"state": info["state"]})
    np.testing.assert_allclose(env.reset(options={"state": states[100]})[1]["state"], states[100], atol=1e-15)
    ending = gym.make("SegorogeniAUV-v0", max_thrust=8.0)
    ending.reset(seed=1)
    assert any(ending.step(LOOP)[2] for _ in range(400))


def run_of(kind, steps):
    """Errors of the tangent and covariances of a filter around the loop, without position."""
    arguments = {**LOOPING, "sensors": ["u", "v", "w", "p", "q", "r", "g_x", "g_y", "g_z", "m_x", "m_y", "m_z"]}
    env = filters.EstimateState(gym.make("SegorogeniAUV-v0", **arguments), filter=kind)
    env.reset(seed=3)
    errors, covs = [], []
    for _ in range(steps):
        info = env.step(LOOP)[-1]
        errors.append(difference(info["state"][:10], info["estimate"], ROTATING))
        covs.append(info["estimate_cov"])
    return np.array(errors), np.array(covs)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_filters_follow_the_loop(kind):
    """The mean NEES of nine errors over 18 s is theirs, within what correlated errors leave."""
    errors, covs = run_of(kind, 400)
    nees = np.einsum("ki,ki->k", errors, np.linalg.solve(covs, errors[..., None])[..., 0])
    assert 6.0 < nees[40:].mean() < 13.0


def test_what_it_cannot_do_it_refuses():
    env = gym.make("SegorogeniAUVPath-v0", attitude="quaternion")
    with pytest.raises(ValueError, match="attitude must be 'euler' for this controller"):
        DepthAndCourse.for_env(env)
    with pytest.raises(ValueError, match="'quaternion'"):
        gym.make("SegorogeniAUV-v0").unwrapped.state_space_model(attitude="quaternion")
    with pytest.raises(ValueError, match="states of an attitude 'quaternion' must be"):
        auv_model(attitude="quaternion", states="current")
    with pytest.raises(ValueError, match="integration"):
        auv_model(attitude="quaternion", integration="euler")
    with pytest.raises(ValueError, match="a channel of sensors must be"):
        make_plant(sensors=["g_x"])
    with pytest.raises(ValueError, match="states must be numbers and angles here"):
        filters.run(filters.KalmanFilter(model=auv_model(attitude="quaternion")), measurements=np.zeros((2, 9)))


def test_a_step_of_the_loop_is_of_order_four():
    """Through a pitch of 90 degrees, too: half the step has a sixteenth of the error."""

    def flown(count):
        c, x = derive_constants(SEGOROGENI, 10.0 / count), rotating_state((1.0,) + (0.0,) * 11)
        for _ in range(count):
            x = rotating_substep(x, (8.0, -0.048, LOOP[1], 0.0), c)
        return np.array(x)

    coarse, middle, fine = map(flown, (200, 400, 800))
    assert 10.0 < np.abs(coarse - middle).max() / np.abs(middle - fine).max() < 24.0
