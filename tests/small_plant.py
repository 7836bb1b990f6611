"""A second plant, as small as one can be: a cart with a motor, three states, two inputs, two channels.

It is what the rooms below a plant are tested with, and shows what a plant has to bring: an equation, a page, and
an env that names its arguments.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import arguments_of, positive, takes_arguments_of
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS
from thruster_env.effects.effects import Context, chain_of, dropping_channels, run_chain
from thruster_env.effects.sensors import SENSOR_EFFECTS, Reading
from thruster_env.env.copies import Channel, Page, correlated, root_of
from thruster_env.env.env import PlantEnv, PlantVectorEnv
from thruster_env.env.model_env import ModelledEnv
from thruster_env.graphs.graphs import where
from thruster_env.model.affine import affine_model
from thruster_env.model.quantities import Quantity

STATES = (Quantity("position", "p", "m"), Quantity("speed", "v", "m/s"), Quantity("force", "F", "N"))
INPUTS = (Quantity("command", "u", "V"), Quantity("slope", "s", "m/s^2"))
POSITION, SPEED, FORCE = STATES
CHANNELS = {
    "speed": Channel(SPEED, 0.04, lambda x, y, u, c: x[1], lambda x, dy, c: (0, 1, 0)),
    "position": Channel(POSITION, 0.01, lambda x, y, u, c: x[0], lambda x, dy, c: (1, 0, 0)),
}
Q, P_0 = np.diag([1e-6, 1e-4, 4e-4]), np.diag([0.1, 0.01, 0.01])


class Cart(NamedTuple):
    """A cart, sampled every dt seconds."""

    dt: float
    mass: float
    sensors: dict

    @property
    def matrices(self):
        """A (3, 3) and B (3, 2) of one step."""
        dt, m = self.dt, self.mass
        return np.array([[1.0, dt, 0.0], [0.0, 1.0 - dt, dt / m], [0.0, 0.0, 0.9]]), np.array(
            [[0, 0], [0, dt], [0.1, 0]]
        )

    @property
    def r(self):
        """R (m, m)."""
        return np.diag([CHANNELS[name].variance for name in self.sensors])


def make_cart(mass: float = 2.0, dt: float = 0.1, sensors=("position", "speed")) -> Cart:
    """Make a cart of so many kilograms; raises ValueError for wrong numbers."""
    given = sensors if isinstance(sensors, dict) else dict.fromkeys(sensors)
    effects = {name: SENSOR_EFFECTS.make(given[name]) for name in given}
    return Cart(positive("dt", dt), positive("mass", mass), effects)


def cart_model(cart: Cart, process_noise_cov=None):
    """The cart's model, exact unless its Q is another."""
    a, b = cart.matrices
    return affine_model(
        a=a,
        b=b,
        c=[CHANNELS[name].slopes(None, None, None) for name in cart.sensors],
        process_noise_cov=Q if process_noise_cov is None else process_noise_cov,
        measurement_noise_cov=cart.r,
        prior_mean=np.zeros(3),
        prior_cov=P_0,
        states=STATES,
        input_quantities=INPUTS,
        measurements=[CHANNELS[name].quantity for name in cart.sensors],
    )


class Parameters(NamedTuple):
    dt: float
    a: Any
    b: Any
    prior_mean: Any
    prior_root: Any
    q_root: Any
    r_root: Any
    effects: Any


@lru_cache
def cart_page(kinds, channels) -> Page:
    def observed(p, x, memories, t):
        noise, readings, after = correlated(p.r_root, t.draws.normals(MEASUREMENT)), [], []
        for i, name in enumerate(channels):
            reading = Reading(CHANNELS[name].read(x, (), (), ()) + noise[i], 1.0)
            reading, memory = run_chain(kinds[i], p.effects[i], reading, memories and memories[i], t)
            readings, after = [*readings, reading], [*after, memory]
        report = {
            "state": x,
            "measurement": tuple(r.z for r in readings),
            "valid": tuple(r.valid for r in readings),
        }
        report |= {"force": x[2], "time": t.step * p.dt, "terminated": where(abs(x[0]) > 0.8, 1.0, 0.0)}
        return (x, tuple(after)), report

    def begin(p, t):
        noise = correlated(p.prior_root, t.draws.normals(INITIAL))
        return observed(p, tuple(m + w for m, w in zip(p.prior_mean, noise, strict=True)), None, t)

    def step(p, memory, action, t):
        x, memories = memory
        rows = zip(p.a, p.b, correlated(p.q_root, t.draws.normals(PROCESS)), strict=True)
        x = tuple(sum(k * v for k, v in zip((*a, *b), (*x, *action), strict=True)) + w for a, b, w in rows)
        memory, report = observed(p, x, memories, t)
        return memory, {"reward": -(x[0] * x[0])} | report

    return Page(begin, step, len(INPUTS))


def page_of(cart: Cart, task: None):
    chains = [chain_of(effects, Context(cart.dt), 64 * i) for i, effects in enumerate(cart.sensors.values())]
    a, b = (tuple(map(tuple, matrix.tolist())) for matrix in cart.matrices)
    roots = [root_of(cov) for cov in (P_0, Q, cart.r)]
    p = Parameters(cart.dt, a, b, (0.0,) * 3, *roots, tuple(parameters for _, parameters in chains))
    return cart_page(tuple(kinds for kinds, _ in chains), tuple(cart.sensors)), p


class ModelledCart(ModelledEnv):
    plant_name = "a cart"

    def model_maker(self):
        return cart_model


class CartEnv(ModelledCart, PlantEnv):
    """Keep a cart near its origin. The list of arguments is that of `make_cart`."""

    inputs = INPUTS
    page_of = staticmethod(page_of)

    @takes_arguments_of(make_cart)
    def __init__(self, *, render_mode=None, **arguments):
        self.plant = make_cart(**arguments_of(make_cart, arguments))
        space = gym.spaces.Box(np.float32([-5.0, -1.0]), np.float32([5.0, 1.0]))
        info, dropping = ("state", "measurement", "time"), dropping_channels(self.plant.sensors)
        self._set_up(space, info, ("force",), dropping, render_mode)


class CartVectorEnv(ModelledCart, PlantVectorEnv):
    single_env = CartEnv
