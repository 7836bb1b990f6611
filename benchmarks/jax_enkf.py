"""The ensemble Kalman filter by hand in JAX: jit, vmap over trajectories, scan over steps, float64 on the CPU.

What a user of JAX would write, but for the equations of motion: these are our own, plain operators that JAX traces
as they stand. The filter is that of `filters.ensembles.stochastic`, in array code that knows no JAX, so that a
test can run it on NumPy's arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from thruster_env.core.checks import covariance_root
from thruster_env.core.threads import cores
from thruster_env.thruster.dynamics import substep, thrust_and_torque
from thruster_env.thruster.plant import Plant

NORMALS = 3  # a member and step: one for each state, one for the measurement


class Operand(NDArrayOperatorsMixin):
    """An array of some module under operators, whose power 1/2 is a square root.

    JAX calls the general power for x**0.5, and a Runge-Kutta step takes three times as long.
    """

    def __init__(self, arrays, values):
        self.arrays, self.values = arrays, values

    def __array_ufunc__(self, ufunc, method, *inputs):
        values = [x.values if isinstance(x, Operand) else x for x in inputs]
        if ufunc is np.power and values[1] == 0.5:
            return Operand(self.arrays, self.arrays.sqrt(values[0]))
        return Operand(self.arrays, getattr(self.arrays, ufunc.__name__)(*values))


class ArrayFilter(NamedTuple):
    """A stochastic ensemble filter of a thruster with a thrust sensor, for members (2, N) and normals (3, N)."""

    start: Callable  # start(normals, z): members drawn from the prior, updated with the first measurement
    step: Callable  # step(members, voltage, normals, z): members moved and stirred, then updated
    moments: Callable  # moments(members): mean (2,) and covariance (2, 2)


def repeat(function: Callable, count: int, x):
    """function(function(... x)), count times."""
    for _ in range(count):
        x = function(x)
    return x


def array_filter(plant: Plant, arrays, repeat: Callable = repeat) -> ArrayFilter:
    """The filter for a plant, on the arrays of a module: numpy or jax.numpy.

        x_j = f(x_j, u) + w_j,  y_j = T(x_j),  S = var(y) + R,  K = cov(x, y)/S,  x_j += K (z - v_j - y_j)

    Sums of products are written out: XLA is slow at small matrix products in batches.
    """
    c = plant.constants
    prior_mean = np.asarray(plant.initial_mean)[:, None]
    prior_root, q_root = covariance_root(plant.initial_cov), covariance_root(plant.process_noise_cov)
    (r,) = np.ravel(plant.measurement_noise_cov)

    def on_components(function, x):
        results = function(tuple(Operand(arrays, component) for component in x))
        return arrays.stack([component.values for component in results])

    def correlated(root, normals):
        return arrays.stack([root[0, 0] * normals[0], root[1, 0] * normals[0] + root[1, 1] * normals[1]])

    def update(members, normals, z):
        predicted = on_components(lambda x: thrust_and_torque(x, c)[:1], members)[0]
        distances = members - members.mean(axis=1, keepdims=True)
        of_predicted, degrees = predicted - predicted.mean(), members.shape[1] - 1
        s = (of_predicted * of_predicted).sum() / degrees + r
        gain = (distances * of_predicted).sum(axis=1) / degrees / s
        return members + gain[:, None] * (z - r**0.5 * normals - predicted)

    def start(normals, z):
        return update(prior_mean + correlated(prior_root, normals), normals[2], z)

    def step(members, voltage, normals, z):
        u = Operand(arrays, voltage), plant.ambient_velocity
        members = repeat(lambda m: on_components(lambda x: substep(x, u, c), m), plant.substeps, members)
        return update(members + correlated(q_root, normals), normals[2], z)

    def moments(members):
        mean = members.mean(axis=1)
        distances = members - mean[:, None]
        return mean, (distances[:, None] * distances[None]).sum(axis=2) / (members.shape[1] - 1)

    return ArrayFilter(start, step, moments)


@cache
def _jax():
    import jax  # an extra of the benchmarks alone

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", cores())
    jax.config.update("jax_enable_x64", True)
    return jax


def jax_filter(plant: Plant, size: int, seed: int, devices: int = 1) -> Callable:
    """Return `estimate(voltages, measurements)`, compiled: what the filter finds for many trajectories.

    Voltages are (B, K), measurements (B, K + 1); it returns means (B, K + 1, 2) and covariances (B, K + 1, 2, 2).
    On one device XLA uses the cores where it sees fit; with a device a core each has its part of the trajectories.
    """
    jax = _jax()

    def loop(function, count, x):
        return jax.lax.fori_loop(0, count, lambda _, y: function(y), x)

    filter_ = array_filter(plant, jax.numpy, loop)

    def draw(key):
        return jax.random.normal(key, (NORMALS, size))

    def advance(members, scanned):
        voltage, z, key = scanned
        members = filter_.step(members, voltage, draw(key), z)
        return members, filter_.moments(members)

    def trajectory(key, voltages, z):
        of_prior, of_steps = jax.random.split(key)
        members = filter_.start(draw(of_prior), z[0])
        first = filter_.moments(members)
        _, later = jax.lax.scan(advance, members, (voltages, z[1:], jax.random.split(of_steps, len(voltages))))
        return tuple(jax.numpy.concatenate([a[None], b]) for a, b in zip(first, later, strict=True))

    batch = jax.jit(jax.vmap(trajectory))
    mesh = jax.make_mesh((devices,), ("trajectories",))
    shared = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("trajectories"))

    def estimate(voltages, measurements):
        keys = jax.random.split(jax.random.key(seed), len(voltages))
        sharded = (jax.device_put(part, shared) for part in (keys, voltages, measurements))
        return tuple(np.asarray(part) for part in batch(*sharded))

    return estimate
