"""Evaluations and many trajectories on all cores, beside the least arithmetic that they need, and JAX."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib.util import find_spec
from math import cos, gcd, sin, tan
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from benchmarks.timing import Measure, Row, alone, side_by_side
from filters import StateSpaceModel, affine_model, make_filter, run
from filters.filter import Filter
from thruster_env.core.checks import covariance_root
from thruster_env.core.parallel import cores, spread
from thruster_env.core.sources import column_reader, column_writer, vector_reader
from thruster_env.core.streams import FILTER_PROCESS, episode_keys, fill_normals
from thruster_env.graphs.loops import Loops
from thruster_env.model import rotations
from thruster_env.model.simulate import simulate
from thruster_env.model.turns import Rotation
from thruster_env.thruster.dynamics import Constants, substep, thrust_and_torque
from thruster_env.thruster.plant import Plant
from tuning.evaluation.evaluate import evaluate
from tuning.plants.thruster import find_scenario
from tuning.problems.data import Data, training_seeds
from tuning.search.space import oracle_choice

SEEDS, ENSEMBLE_SIZE = 64, 50
EVALUATE_GOAL, RUN_GOAL = 2.1, 1.8  # of the floor's time
TURNING_GOAL = 1.5  # of the time of six plain states
NORMALS = 3  # a member and step: one for each state, one for the measurement
WIDTH = 64  # members in one block of the floor: whole vector registers, and all in the fastest cache
BLOCKS = SEEDS * ENSEMBLE_SIZE // WIDTH

_read_constants = vector_reader(len(Constants._fields))
_column, _store = column_reader(2), column_writer(2)
TRAJECTORIES, TRAJECTORY_SIZE = 256, 100
AGREEMENT = 0.03  # how far the RMSE of two filters that differ in their random numbers alone may lie apart
ALONE = "ekf", "ukf"  # filters without an ensemble


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds = 5 if quick else 60
    scenario = find_scenario("nominal")
    data = scenario.data(training_seeds(seed, SEEDS))
    choice = oracle_choice("enkf", scenario).with_size(ENSEMBLE_SIZE)
    count = SEEDS * scenario.steps * ENSEMBLE_SIZE

    def compute_metrics():
        evaluate(choice.filter(scenario), data, scenario.scale)

    floor = floor_measures(scenario.plant, scenario.steps)
    whole_floor = _sum(*floor.values())
    workload = f"{SEEDS} seeds, N = {ENSEMBLE_SIZE}"
    timing = side_by_side(shared(compute_metrics, count), whole_floor, rounds)
    yield Row(f"evaluate, {workload}", "floor", timing, ratio_goal=EVALUATE_GOAL)
    timing = side_by_side(shared(lambda: estimates(choice.filter(scenario), data), count), whole_floor, rounds)
    yield Row("the same without metrics", "floor", timing, ratio_goal=RUN_GOAL)
    for name, measure in floor.items():
        yield Row(f"floor: {name}", None, alone(measure, rounds))


def shared(work: Callable[[], object], count: int) -> Measure:
    """A measure of work that is shared by `count` members and steps."""

    def measure() -> float:
        begin = perf_counter()
        work()
        return (perf_counter() - begin) / count

    return measure


def _sum(*measures: Measure) -> Measure:
    return lambda: sum(measure() for measure in measures)


def floor_measures(plant: Plant, steps: int) -> dict[str, Measure]:
    """Measures, by name, of the least work of each member and step: its motion and its noise.

    As many members and steps as in the evaluation, spread over the cores in the same way, but with no
    moments, no gain, nothing stored and no member that is only there to fill a register.
    """
    propagate, draw = _floor_functions()
    numbers = np.array(plant.constants)

    def motion(first: int, last: int) -> None:
        table = np.zeros((2, WIDTH))
        for _ in range(first, last):
            propagate(table, steps, plant.substeps, numbers)

    def noise(first: int, last: int) -> None:
        draws = np.zeros(NORMALS * WIDTH)
        for block in range(first, last):
            draw(draws, steps, block)

    count = BLOCKS * WIDTH * steps
    return {
        f"{plant.substeps} Runge-Kutta steps": shared(lambda: spread(motion, BLOCKS), count),
        f"{NORMALS} normals": shared(lambda: spread(noise, BLOCKS), count),
    }


@cache
def _floor_functions() -> tuple[Callable, Callable]:

    def propagate(table, steps, substeps, numbers):
        c = Constants(*_read_constants(numbers))
        for _ in range(steps):
            for _ in range(substeps):
                for j in range(table.shape[1]):
                    _store(table, j, substep(_column(table, j), (12.0, c.ambient_velocity), c))

    def draw(draws, steps, key):
        for step in range(steps):
            fill_normals(draws, draws.shape[0], step, FILTER_PROCESS, key, 0)

    return Loops(propagate), Loops(draw)


def trajectory_rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    scenario = find_scenario("nominal")
    count = TRAJECTORIES // 4 if quick else TRAJECTORIES
    data, steps = scenario.data(training_seeds(seed, count)), count * scenario.steps
    for name in ALONE:
        filter_ = oracle_choice(name, scenario).filter(scenario)
        measure = shared(partial(estimates, filter_, data), steps)
        timing = alone(measure, 5 if quick else 40)
        yield Row(f"{name.upper()} batch, a step", None, timing)

    filter_ = oracle_choice("enkf", scenario).with_size(TRAJECTORY_SIZE).filter(scenario)
    ours = shared(partial(estimates, filter_, data), steps * TRAJECTORY_SIZE)
    rounds, what = 2 if quick else 10, f"EnKF batch, N = {TRAJECTORY_SIZE}"
    yield Row(what, None, alone(ours, 5 * rounds))
    if find_spec("jax") is None:
        yield Row(what, "JAX is not installed", alone(ours, rounds))
        return
    arrays = data.inputs[..., 0], data.measurements[..., 0]
    parts = gcd(cores(), count)
    for devices, name, goal in ((1, "JAX", 1 / 7), (parts, f"JAX, {parts} devices", None)):
        estimate = partial(jax_filter(scenario.plant, TRAJECTORY_SIZE, seed, devices), *arrays)
        check_agreement(estimates(filter_, data), estimate()[0], data.states)
        peer = shared(estimate, steps * TRAJECTORY_SIZE)
        yield Row(what, name, side_by_side(ours, peer, rounds, warm_up=False), ratio_goal=goal)


def attitude_rows(seed: int, quick: bool) -> Iterator[Row]:
    """An EKF of a rotation, seven stored numbers and six in the tangent, beside those of six numbers."""
    count, steps, rounds = (32, 100, 5) if quick else (256, 400, 40)
    inputs = 0.1 * np.random.default_rng(seed).normal(size=(count, steps, 3))
    measures = {}
    for name, model in attitude_models().items():
        drawn, filter_ = simulate(model, episode_keys(range(count)), inputs), make_filter("ekf", model)
        filtered = partial(run, filter_, inputs=inputs, measurements=drawn.measurements)
        measures[name] = shared(filtered, count * steps)
    ours = measures.pop("rotation")
    for name, peer in measures.items():
        timing = side_by_side(ours, peer, rounds)
        yield Row("EKF batch of a rotation and a bias, a step", name, timing, ratio_goal=TURNING_GOAL)


def attitude_models(dt: float = 0.01) -> dict[str, StateSpaceModel]:
    """A gyroscope with a bias as input; gravity and the magnetic field, or three angles twice, are measured."""
    fields = (0.0, 0.0, 9.81), (20.0, 0.0, 40.0)

    def turn(x, u, c):
        d = tuple(dt * (rate - bias) for rate, bias in zip(u, x[4:], strict=True))
        return (*rotations.product(x[:4], rotations.exponential(d)), *x[4:])

    def see(x, c):
        return tuple(z for field in fields for z in rotations.to_body(x[:4], field))

    def turn_angles(x, u, c):
        p, q, r = (rate - bias for rate, bias in zip(u, x[3:], strict=True))
        across = q * sin(x[0]) + r * cos(x[0])
        rates = p + across * tan(x[1]), q * cos(x[0]) - r * sin(x[0]), across / cos(x[1])
        return (*(angle + dt * rate for angle, rate in zip(x[:3], rates, strict=True)), *x[3:])

    def see_angles(x, c):
        half = [0.5 * angle for angle in x[:3]]
        roll, pitch, yaw = ((cos(h), *(sin(h) * (i == axis) for i in range(3))) for axis, h in enumerate(half))
        q = rotations.product(yaw, rotations.product(pitch, roll))
        return tuple(z for field in fields for z in rotations.to_body(q, field))

    noise = {"process_noise_cov": [1e-5] * 6, "measurement_noise_cov": [0.01] * 6, "prior_cov": [0.1] * 6}
    turning = {"transition": turn, "observe": see, "states": (Rotation("attitude"), "b_x", "b_y", "b_z")}
    angles = {"transition": turn_angles, "observe": see_angles, "prior_mean": [0.0] * 6}
    eye, zero = np.eye(3), np.zeros((3, 3))
    return {
        "rotation": StateSpaceModel(inputs=3, prior_mean=[1.0] + [0.0] * 6, **turning, **noise),
        "six numbers": affine_model(
            a=np.block([[eye, -dt * eye], [zero, eye]]),
            b=np.vstack([dt * eye, zero]),
            c=np.block([[eye, zero], [eye, zero]]),
            prior_mean=[0.0] * 6,
            **noise,
        ),
        "roll, pitch and yaw": StateSpaceModel(inputs=3, **angles, **noise),
    }


def estimates(filter_: Filter, data: Data) -> np.ndarray:
    """The means that a filter finds, (B, K + 1, n)."""
    return run(filter_, data.filter_keys, data.inputs, data.measurements).means


def check_agreement(ours: np.ndarray, theirs: np.ndarray, states: np.ndarray) -> None:
    """Raise ValueError unless two filters' estimates (B, K + 1, n) are equally accurate, so that times compare."""
    ratio = np.sqrt(np.mean((ours - states) ** 2, axis=(0, 1)) / np.mean((theirs - states) ** 2, axis=(0, 1)))
    if np.any(np.abs(ratio - 1.0) > AGREEMENT):
        raise ValueError(f"two ensemble filters must have the same RMSE within {AGREEMENT:.0%}, but got {ratio}")


# The ensemble Kalman filter by hand in JAX: jit, vmap over trajectories, scan over steps, float64 on the CPU, as a
# user of JAX would write it, but for the equations of motion, which are our own: JAX traces their operators. The
# filter is that of `filters.ensembles`, in array code that knows no JAX, so that a test can run it on NumPy.


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
