"""Simulation of a model: states and measurements of many trajectories with the model's own noise."""

from __future__ import annotations

import time
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import as_floats
from thruster_env.core.compiled import instead_of, is_interpreting
from thruster_env.core.sources import vector_reader, vector_writer
from thruster_env.core.streams import GROUP, INITIAL, MEASUREMENT, PROCESS, fill_normals
from thruster_env.model.shape import Functions, Shape, constants_reader, for_any_input, padded
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import called_function
from thruster_env.model.turns import Turn, move


def inputs_until(inputs: np.ndarray) -> np.ndarray:
    """The input that acts until each row, (..., K + 1, p), of inputs (..., K, p): none before the first step."""
    return np.concatenate((np.zeros_like(inputs[..., :1, :]), inputs), axis=-2)


class Truth(NamedTuple):
    """True states and measurements of B trajectories over K steps.

    Attributes:
        states: (B, K + 1, n), in the units of the states.
        measurements: (B, K + 1, m), in the units of the measurements.
    """

    states: np.ndarray
    measurements: np.ndarray


def add_correlated(out, numbers, root, count, draws):
    """Out += L draws, the lower triangular L (count, count) lying by rows at numbers[root]."""
    for i in range(count):
        for k in range(i + 1):
            out[i] += numbers[root + i * count + k] * draws[k]


@cache
def noise_step(shape: Shape):
    """Function disturb(x, draws, step, key, numbers), which moves an array x (n,) by a step's process noise."""
    t, q_root, add = shape.t, shape.offsets.q_root, _noise_adder(shape.n, shape.turns)

    def disturb(x, draws, step, key_0, key_1, numbers):
        fill_normals(draws, t, step, PROCESS, key_0, key_1)
        add(x, numbers, q_root, draws)

    return disturb


def _noise_adder(n: int, turns: tuple[Turn, ...]):
    """Function add(x, numbers, root, draws): x (n,) moved by L draws, with L (t, t) by rows at numbers[root]."""
    t = n - len(turns)
    if not turns:

        def add(x, numbers, root, draws):
            add_correlated(x, numbers, root, n, draws)

        return add

    def moved(x, d, c):
        return tuple(move(x, d, turns))

    function = called_function(moved, "x, u, c", (n, t, 0), 0, (n,))
    state, store_state, error = vector_reader(n), vector_writer(n), vector_reader(t)

    def add_on_tangent(x, numbers, root, draws):
        d = np.zeros(t)
        add_correlated(d, numbers, root, t, draws)
        store_state(x, function(state(x), error(d), ()))

    return add_on_tangent


@lru_cache(maxsize=64)
def truth_steps(functions: Functions, shape: Shape):
    """Functions begin(x, draws, key, numbers), advance(x, u, draws, step, key, numbers), measure(z, x, u, ...).

    They work on arrays x (n,), u (inputs,), z (channels,), draws with room for GROUP multiples, key (2,).
    """
    n, t, m, transition, observe = shape.n, shape.t, shape.m, functions.transition, functions.observe
    source, channels, add_noise = shape.offsets, shape.channels, _noise_adder(n, shape.turns)
    add_error = _noise_adder(channels, shape.measured_turns)
    prior_mean, prior_root, substeps = source.prior_mean, source.prior_root, source.substeps
    r_root, disturb = source.r_root, noise_step(shape)
    state, store_state, store_measurement = vector_reader(n), vector_writer(n), vector_writer(channels)
    control, constants = vector_reader(shape.inputs), constants_reader(shape)
    look = for_any_input(observe, shape)

    def begin(x, draws, key_0, key_1, numbers):
        fill_normals(draws, t, 0, INITIAL, key_0, key_1)
        for i in range(n):
            x[i] = numbers[prior_mean + i]
        add_noise(x, numbers, prior_root, draws)

    def advance(x, u, draws, step, key_0, key_1, numbers):
        v, c = control(u), constants(numbers)
        for _ in range(int(numbers[substeps])):
            store_state(x, transition(state(x), v, c))
        disturb(x, draws, step, key_0, key_1, numbers)

    def measure(z, x, u, draws, step, key_0, key_1, numbers):
        store_measurement(z, look(state(x), control(u), constants(numbers)))
        fill_normals(draws, m, step, MEASUREMENT, key_0, key_1)
        add_error(z, numbers, r_root, draws)

    return begin, advance, measure


def truth_steps_of(model: StateSpaceModel):
    """`truth_steps` for a model."""
    return truth_steps(model.functions, model.any_shape)


@lru_cache(maxsize=64)
def _simulation(begin, advance, measure, n: int, m: int, interpreting: bool):
    from thruster_env.graphs.loops import Loops

    room = padded(max(n, m), GROUP)

    def simulate(keys, inputs, numbers, states, measurements):
        x, z, u, draws = np.zeros(n), np.zeros(m), np.zeros(inputs.shape[2]), np.zeros(room)
        for b in range(keys.shape[0]):
            key_0, key_1 = keys[b, 0], keys[b, 1]
            begin(x, draws, key_0, key_1, numbers)
            for i in range(u.shape[0]):
                u[i] = 0.0
            for k in range(states.shape[1]):
                if k > 0:
                    for i in range(u.shape[0]):
                        u[i] = inputs[b, k - 1, i]
                    advance(x, u, draws, k, key_0, key_1, numbers)
                measure(z, x, u, draws, k, key_0, key_1, numbers)
                for i in range(n):
                    states[b, k, i] = x[i]
                for i in range(m):
                    measurements[b, k, i] = z[i]

    shapes = (None, 2), (None, None, None), (None,), (None, None, n), (None, None, m)
    return Loops(simulate, shapes)


def seconds_as_python(model: StateSpaceModel) -> float:
    """The time [s] that f and h of a step take, of a model that runs as Python; 0 for one of machine code.

    Functions that are not traced are compiled, or a warning says that they run as Python.
    """
    replacements = [instead_of(function) for function in (model.functions.transition, model.functions.observe)]
    if is_interpreting() or not any(instead is None or instead.reason for instead in replacements):
        return 0.0
    key, inputs = np.zeros((1, 2)), np.zeros((1, 1, model.inputs))
    simulate(model, key, inputs)
    if not _simulation(*truth_steps_of(model), model.n, model.channels, is_interpreting()).in_python:
        return 0.0
    started = time.perf_counter()
    simulate(model, key, inputs)
    return 0.5 * (time.perf_counter() - started)  # of two measurements and a step


def simulate(model: StateSpaceModel, keys: np.ndarray, inputs: np.ndarray) -> Truth:
    """Simulate a model with its own noise, one trajectory for every key.

        x_{k+1} = f(x_k, u_k) + w_k,  w_k ~ N(0, Q);   z_k = h(x_k) + v_k,  v_k ~ N(0, R);   x_0 ~ N(mean, cov)

    If h takes the input, z_{k+1} = h(x_{k+1}, u_k) + v_{k+1} and z_0 = h(x_0, 0) + v_0.

    The same keys give the same noise as in the plant, so that an exact model gives the plant's trajectories.
    Rotations, directions and poses move by w on their tangent, as `thruster_env.model.turns` has it.
    Angles are not wrapped: filters and errors (`thruster_env.core.angles.difference`) wrap them.

    Args:
        model: the model, with Q, R and the prior.
        keys: random keys, one per trajectory, (B, 2).
        inputs: u, (B, K, p), in the units of the inputs.

    Returns:
        `Truth`: states (B, K + 1, n) and measurements (B, K + 1, m).

    Raises:
        ValueError: if shapes do not fit.
    """
    inputs, keys = (np.ascontiguousarray(as_floats(a)) for a in (inputs, keys))
    if inputs.ndim != 3 or inputs.shape[2] != model.inputs or keys.shape != (len(inputs), 2):
        raise ValueError(
            f"keys and inputs must have shapes (B, 2) and (B, K, {model.inputs}), "
            f"but got {keys.shape} and {inputs.shape}"
        )
    count, steps, _ = inputs.shape
    truth = Truth(np.empty((count, steps + 1, model.n)), np.empty((count, steps + 1, model.channels)))
    run = _simulation(*truth_steps_of(model), model.n, model.channels, is_interpreting())
    run(keys, inputs, model.numbers, truth.states, truth.measurements)
    return truth
