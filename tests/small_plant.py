"""A second plant, as small as one can be: a cart with a motor, three states, two inputs, two channels.

It is what the rooms below a plant are tested with, and shows what a plant has to bring: an equation, where its
rows lie, a step, and an env that names its arguments.
"""

from __future__ import annotations

from typing import NamedTuple

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import arguments_of, covariance_root, positive, takes_arguments_of, vector
from thruster_env.core.checks import options as checked_options
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import FIRST_REPORTED, FRONT, REWARD, STEP, TERMINATED, TIME
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS
from thruster_env.effects.effects import Context, chain_of, dropping_channels, encoded
from thruster_env.effects.sensors import SENSOR_EFFECTS
from thruster_env.env.copies import BLOCK, Channel, PlantCopies, add_noise, machine_code_of, reader_of
from thruster_env.env.env import PlantEnv, PlantVectorEnv, ReportRows
from thruster_env.env.model_env import ModelledEnv
from thruster_env.model.affine import affine_model
from thruster_env.model.quantities import Quantity

STATES = (Quantity("position", "p", "m"), Quantity("speed", "v", "m/s"), Quantity("force", "F", "N"))
INPUTS = (Quantity("command", "u", "V"), Quantity("slope", "s", "m/s^2"))
POSITION, SPEED, FORCE = STATES
CHANNELS = {
    "speed": Channel(SPEED, 0.04, 5, lambda x, y, u, c: x[1], lambda x, dy, c: (0, 1, 0)),
    "position": Channel(POSITION, 0.01, 2, lambda x, y, u, c: x[0], lambda x, dy, c: (1, 0, 0)),
}
KINDS = tuple(SENSOR_EFFECTS.effects.values())
Q, P_0 = np.diag([1e-6, 1e-4, 4e-4]), np.diag([0.1, 0.01, 0.01])

X = len(FRONT)  # three states, then readings, whether they are valid, and what is not reported
READINGS, VALID, REPORTED, COMMAND, SCRATCH = X + 3, X + 5, X + 7, X + 7, X + 9
ROWS = SCRATCH + BLOCK
A, B, MEAN, P_ROOT, Q_ROOT, R_ROOT, CODES, DT, COUNT, EFFECTS = np.cumsum([0, 9, 6, 3, 9, 9, 4, 2, 1, 1]).tolist()


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


def of_copy(read):
    return inlined(
        lambda memory, b, j: read((memory[b, X, j], memory[b, X + 1, j], memory[b, X + 2, j]), (), (), ())
    )


read = reader_of(tuple(CHANNELS.values()), of_copy, "memory, b, j")
sense = chain_of(KINDS, COUNT)


@inlined
def move(memory, b, numbers, begin):
    for j in range(memory.shape[2]):
        memory[b, STEP, j] = 0.0 if begin else memory[b, STEP, j] + 1.0
        x, y, z = memory[b, X, j], memory[b, X + 1, j], memory[b, X + 2, j]
        for i in range(3):
            state = numbers[A + 3 * i] * x + numbers[A + 3 * i + 1] * y + numbers[A + 3 * i + 2] * z
            drive = numbers[B + 2 * i] * memory[b, COMMAND, j] + numbers[B + 2 * i + 1] * memory[b, COMMAND + 1, j]
            memory[b, X + i, j] = numbers[MEAN + i] if begin else state + drive


def step(first, last, memory, numbers, out, begin):
    for b in range(first, last):
        move(memory, b, numbers, begin)
        if begin:
            add_noise(memory, b, numbers, 3, X, P_ROOT, INITIAL, SCRATCH)
        else:
            add_noise(memory, b, numbers, 3, X, Q_ROOT, PROCESS, SCRATCH)
        for j in range(memory.shape[2]):
            for i in range(2):
                memory[b, READINGS + i, j] = read(numbers[CODES + i], memory, b, j)
                memory[b, VALID + i, j] = 1.0
            memory[b, REWARD, j] = 0.0 if begin else -memory[b, X, j] * memory[b, X, j]
            memory[b, TERMINATED, j] = 1.0 if abs(memory[b, X, j]) > 0.8 else 0.0
            memory[b, TIME, j] = memory[b, STEP, j] * numbers[DT]
        add_noise(memory, b, numbers, 2, READINGS, R_ROOT, MEASUREMENT, SCRATCH)
        sense(memory, b, numbers, EFFECTS, begin)
        for i in range(FIRST_REPORTED, REPORTED):
            for j in range(memory.shape[2]):
                out[i, b, j] = memory[b, i, j]


class Carts(PlantCopies):
    commands, reported = (COMMAND, COMMAND + 1), REPORTED

    def encode(self, cart: Cart):
        self.context, program, rows = Context(cart.dt, VALID - READINGS), [], 0
        for i, effects in enumerate(cart.sensors.values()):
            code, taken = encoded(effects, KINDS, READINGS + i, ROWS + rows, 64 * i, self.context)
            program, rows = program + code, rows + taken
        roots = [covariance_root(cov).ravel() for cov in (P_0, Q, cart.r)]
        codes = [CHANNELS[name].code for name in cart.sensors]
        length = sum(map(len, cart.sensors.values()))
        fixed = [
            *(matrix.ravel() for matrix in cart.matrices),
            np.zeros(3),
            *roots,
            codes,
            [cart.dt, length],
            program,
        ]
        return np.concatenate(fixed).astype(np.float64), ROWS + rows

    def machine_code(self):
        return machine_code_of(step)

    def numbers_from(self, options):
        given = checked_options(options).get("state")
        if given is None:
            return None
        numbers = self.numbers.copy()
        numbers[MEAN : MEAN + 3], numbers[P_ROOT : P_ROOT + 9] = vector("the state of options", given, 3), 0.0
        return numbers


class ModelledCart(ModelledEnv):
    plant_name = "a cart"

    def model_maker(self):
        return cart_model


class CartEnv(ModelledCart, PlantEnv):
    """Keep a cart near its origin. The list of arguments is that of `make_cart`."""

    inputs = INPUTS

    @takes_arguments_of(make_cart)
    def __init__(self, *, render_mode=None, **arguments):
        self.plant = make_cart(**arguments_of(make_cart, arguments))
        readings, valid = slice(READINGS, READINGS + 2), slice(VALID, VALID + 2)
        dropping = dropping_channels(self.plant.sensors)
        info = {"state": slice(X, X + 3), "measurement": readings, "time": TIME}
        space = gym.spaces.Box(np.float32([-5.0, -1.0]), np.float32([5.0, 1.0]))
        self._set_up(space, ReportRows(readings, valid, dropping, (X + 2,), info), render_mode)

    def copies_of(self, count):
        return Carts(self.plant, None, count)


class CartVectorEnv(ModelledCart, PlantVectorEnv):
    single_env = CartEnv
