"""Three models as people write them, of loops, arrays and dataclasses: machine code wherever they are used."""

import math
import warnings
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import pytest

from filters import make_filter, run
from filters.c.programs import programs_of
from tests.models import state_space
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.core.derivatives import runge_kutta
from thruster_env.core.streams import episode_keys
from thruster_env.env.model_env import ModelEnv
from thruster_env.model.simulate import simulate
from thruster_env.model.traced import _machine_code

MASSES, STIFFNESS = [1.0, 2.0, 1.5], {"wall": 8.0, "inner": 5.0}


class Chain(NamedTuple):
    """Constants of the chain, with a rule of their own."""

    substep: float = 0.05
    damping: float = 0.3

    def drag(self, speed):
        return self.damping * math.tanh(speed) + 0.1 * math.sqrt(1.0 + speed * speed)


def stretch_of(places):
    stretch = [0.0] * (len(places) + 1)
    for i in range(len(places) + 1):
        left = places[i - 1] if i > 0 else 0.0
        right = places[i] if i < len(places) else 0.0
        stretch[i] = right - left
    return stretch


def chain_rates(x, u, c):
    places, speeds = x[:3], x[3:]
    forces = []
    for i, stretch in enumerate(stretch_of(places)):
        stiffness = STIFFNESS["wall" if i in (0, len(places)) else "inner"]
        if stretch > 0.5:  # it hardens
            stiffness *= 1.0 + (stretch - 0.5)
        forces.append(stiffness * stretch)
    pulls = (right - left - c.drag(v) for left, right, v in zip(forces, forces[1:], speeds, strict=False))
    accelerations = [pull / mass for pull, mass in zip(pulls, MASSES, strict=True)]
    accelerations[0] += u[0]
    return tuple(speeds) + tuple(a for a in accelerations)


def gauges(x, c):
    return tuple(x[i] for i in range(3) if i != 1) + (sum(m * v for m, v in zip(MASSES, x[3:], strict=True)),)


def chain():
    noise = {"q": [1e-6] * 3 + [1e-4] * 3, "r": [1e-2] * 3}
    prior = {"mean": [0.1, 0.7, -0.2, 0.0, 0.3, 0.0], "cov": [0.01] * 6}
    return state_space(runge_kutta(chain_rates, 6), gauges, **noise, **prior, constants=Chain())


INERTIA = np.array([[2.0, 0.1, 0.0], [0.1, 1.5, 0.0], [0.0, 0.0, 1.0]])
AXES = np.eye(3)


def skew(w):
    matrix = np.zeros((3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[j, i], matrix[i, j] = w[k], -w[k]
    return matrix


def turn(x, u, c):
    w, dt = np.array(x), c[0]
    mixing = AXES.copy()
    mixing[0, 1] = 0.2 * np.sin(w[2])
    torque = mixing @ np.concatenate([np.array(u), [0.0]])
    w_dot = np.linalg.solve(INERTIA, torque - skew(w) @ INERTIA @ w) - c[1] * np.linalg.norm(w) * w
    return w + dt * w_dot


def gyroscope(x, c):
    rates = np.asarray(x)
    energy = 0.5 * np.dot(rates, INERTIA.dot(rates))
    return np.append(np.clip(rates, -3.0, 3.0), np.where(energy > 2.0, 2.0 + 0.1 * (energy - 2.0), energy))


def body():
    noise, prior = {"q": [1e-4] * 3, "r": [1e-2] * 4}, {"mean": [0.5, -0.4, 1.0], "cov": [0.1] * 3}
    return state_space(turn, gyroscope, **noise, **prior, constants=(0.05, 0.2), inputs=2)


@dataclass(frozen=True)
class Thruster:
    """A thruster at an angle."""

    angle: float
    most: float = 2.0
    lag: float = 0.5

    @property
    def direction(self):
        return math.cos(self.angle), math.sin(self.angle)

    def thrust(self, speed):
        push = self.most * math.tanh(speed)
        return push if speed > 0.0 else 0.7 * push

    def rate(self, speed, command):
        return (max(-1.0, min(command, 1.0)) - speed) / self.lag


@dataclass
class Boat:
    """What moves it."""

    thrusters: list[Thruster] = field(default_factory=lambda: [Thruster(0.3), Thruster(-0.4, most=1.5)])
    mass: float = 3.0

    @cached_property
    def drag(self):
        return 0.4 * math.sqrt(self.mass)

    def force(self, speeds):
        total = [0.0, 0.0]
        for thruster, speed in zip(self.thrusters, speeds, strict=True):
            along = thruster.thrust(speed)
            total = [have + along * part for have, part in zip(total, thruster.direction, strict=True)]
        return total


class Observer:
    """A function object with a helper that remembers."""

    def __init__(self, offset):
        self.offset = offset

    @staticmethod
    @lru_cache(maxsize=8)
    def squared(a):
        return a * a

    def __call__(self, x, c):
        return [math.hypot(x[0] - self.offset, x[1]), self.squared(x[2]) + x[3]]


BOAT = Boat()


def boat_step(x, u, c):
    (dt,) = c
    vx, vy, *speeds = x
    fx, fy = BOAT.force(speeds)
    size = math.sqrt(vx * vx + vy * vy + 1e-6)
    new = {
        "vx": vx + dt * (fx - BOAT.drag * size * vx) / BOAT.mass,
        "vy": vy + dt * (fy - BOAT.drag * size * vy) / BOAT.mass,
    }
    return *new.values(), *(s + dt * t.rate(s, v) for t, s, v in zip(BOAT.thrusters, speeds, u, strict=True))


def boat():
    noise, prior = {"q": [1e-4] * 4, "r": [1e-2] * 2}, {"mean": [0.3, 0.1, 0.2, -0.3], "cov": [0.05] * 4}
    return state_space(boat_step, Observer(0.5), **noise, **prior, constants=(0.1,), inputs=2)


MODELS = chain, body, boat
KEYS = episode_keys(range(3))


def inputs_of(model, steps=12):
    return 0.8 * np.sin(0.7 * np.arange(len(KEYS) * steps * model.inputs)).reshape(len(KEYS), steps, model.inputs)


@pytest.fixture(autouse=True)
def without_warnings():
    """Nothing runs as Python."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*as Python")
        yield


@pytest.mark.parametrize("make", MODELS, ids=lambda make: make.__name__)
def test_functions_are_traced_and_exported(make):
    model = make()
    for name, arguments, shape in (("transition", "x, u, c", model.n), ("observe", "x, c", model.m)):
        sizes = (
            (model.n, model.inputs, len(model.constants)) if "u" in arguments else (model.n, len(model.constants))
        )
        assert _machine_code(getattr(model, name), arguments, sizes, model.shape.form, (shape,)).reason == ""
    assert programs_of(make_filter("ekf", model)).all


@pytest.mark.parametrize("make", MODELS, ids=lambda make: make.__name__)
def test_truth_and_env_are_those_of_python(make):
    model = make()
    inputs = inputs_of(model)
    with interpreted():
        expected = simulate(model, KEYS, inputs)
    truth = simulate(model, KEYS, inputs)
    for found, value in zip(truth, expected, strict=True):
        np.testing.assert_allclose(found, value, rtol=1e-12, atol=1e-13)
    env = ModelEnv(model)
    z, _ = env.reset(seed=0)
    np.testing.assert_allclose(z, truth.measurements[0, 0], rtol=1e-13)
    z, *_, info = env.step(inputs[0, 0])
    np.testing.assert_allclose(z, truth.measurements[0, 1], rtol=1e-13)
    np.testing.assert_allclose(info["state"], truth.states[0, 1], rtol=1e-13)


@pytest.mark.parametrize("make", slow_but(list(MODELS), [boat]), ids=lambda make: make.__name__)
def test_estimates_are_those_of_python(make):
    model = make()
    inputs = inputs_of(model)
    with interpreted():
        truth = simulate(model, KEYS, inputs)
        expected = run(make_filter("ekf", model), KEYS, inputs, truth.measurements)
    found = run(make_filter("ekf", model), KEYS, inputs, truth.measurements)
    np.testing.assert_allclose(found.means, expected.means, rtol=1e-10, atol=1e-11)
