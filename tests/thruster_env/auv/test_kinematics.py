import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thruster_env.auv.dynamics import (
    angle_rates,
    attitude_of,
    down,
    in_body_axes,
    in_earth_axes,
)
from thruster_env.core.streams import cosine_and_sine
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import Place, values_of
from thruster_env.graphs.tracing import traced
from tuning.experiments.vehicle_papers import planar_kinematics


def random_angles(count=100):
    rng = np.random.default_rng(0)
    return rng.uniform(-np.pi, np.pi, count), rng.uniform(-1.4, 1.4, count), rng.uniform(-30.0, 30.0, count)


def body_to_earth(phi, theta, psi):
    return Rotation.from_euler("ZYX", np.transpose([psi, theta, phi]))


def test_vectors_turn_as_rotations_have_it():
    phi, theta, psi = random_angles()
    vectors = np.random.default_rng(1).normal(size=(100, 3))
    turned = np.transpose(in_earth_axes(attitude_of(phi, theta), psi, *vectors.T))
    np.testing.assert_allclose(turned, body_to_earth(phi, theta, psi).apply(vectors), atol=1e-13)
    back = np.transpose(in_body_axes(attitude_of(phi, theta), psi, *turned.T))
    np.testing.assert_allclose(back, vectors, atol=1e-13)
    below = body_to_earth(phi, theta, psi).inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(np.transpose(down(attitude_of(phi, theta))), below, atol=1e-13)


def test_angle_rates_are_those_of_a_body_that_turns():
    phi, theta, psi = random_angles()
    omega = np.random.default_rng(2).normal(size=(100, 3))
    rates = np.transpose(angle_rates(attitude_of(phi, theta), *omega.T))
    before, h = body_to_earth(phi, theta, psi), 1e-6
    after, earlier = (before * Rotation.from_rotvec(sign * h * omega) for sign in (1, -1))
    change = (after.as_euler("ZYX") - earlier.as_euler("ZYX"))[:, ::-1]
    change = np.remainder(change + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(rates, change / (2 * h), rtol=1e-6, atol=1e-6)


def test_the_papers_transformation_is_the_full_one_of_a_level_vehicle():
    rng = np.random.default_rng(3)
    nu, psi = rng.normal(size=6), 0.7
    x, y, z, turning = planar_kinematics(tuple(nu), psi)
    level = attitude_of(0.0, 0.0)
    np.testing.assert_allclose((x, y, z), in_earth_axes(level, psi, *nu[:3]), atol=1e-15)
    assert turning == pytest.approx(angle_rates(level, *nu[3:])[2])
    assert in_earth_axes(attitude_of(0.0, -0.2), psi, 1.0, 0.0, 0.0)[2] == pytest.approx(np.sin(0.2))
    assert planar_kinematics((1.0, 0.0, 0.0, 0.0, 0.0, 0.0), psi)[2] == 0.0  # does not dive by pitching


ANGLES = np.concatenate([np.linspace(-12.0, 12.0, 4001), np.arange(-8, 9) * np.pi / 4, [1e-200, 0.0]])


def on_tensors(angles):
    torch = pytest.importorskip("torch")
    given = torch.tensor(angles, requires_grad=True)
    cosine, sine = cosine_and_sine(given)
    sine.sum().backward()
    np.testing.assert_allclose(given.grad.numpy(), np.cos(angles), atol=1e-13)
    return cosine.detach().numpy(), sine.detach().numpy()


def in_machine_code(angles):

    def fill(angles, out):
        for j in range(angles.shape[0]):
            out[0, j], out[1, j] = cosine_and_sine(angles[j])

    out = np.empty((2, len(angles)))
    Loops(fill)(angles, out)
    return out


def on_floats(angles):
    return np.transpose([cosine_and_sine(angle) for angle in angles.tolist()])


def traced_by_programs(angles):
    """Without calls of `fmod`, which is no instruction of vectors, and rounded freely."""
    graph = Graph()
    numbers = list(traced(cosine_and_sine)(graph.given(Place("numbers", 0))))
    assert all(number.operation != "fmod" and not number.exact for number in graph.numbers)
    return values_of(numbers, angles[None])


@pytest.mark.parametrize("way", [cosine_and_sine, on_floats, on_tensors, in_machine_code, traced_by_programs])
def test_cosine_and_sine_are_the_library_s(way):
    for limit, tolerance in ((np.pi / 2, 6e-16), (12.6, 1e-14)):
        angles = ANGLES[np.abs(ANGLES) <= limit]
        cosine, sine = way(angles)
        np.testing.assert_allclose(cosine, np.cos(angles), rtol=0, atol=tolerance)
        np.testing.assert_allclose(sine, np.sin(angles), rtol=0, atol=tolerance)
    assert way(np.array([1e-200, 0.0]))[1].tolist() == pytest.approx([1e-200, 0.0], rel=1e-15, abs=0)
