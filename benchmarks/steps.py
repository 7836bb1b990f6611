"""Steps as a user takes them through Gymnasium: the env alone, with a filter around it, and thousands at once.

FilterPy's filters are set up with exactly the models that ours run on.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import find_spec
from time import perf_counter

import gymnasium as gym
import numpy as np
from filterpy.kalman import EnsembleKalmanFilter, KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from benchmarks.batches import shared
from benchmarks.timing import Measure, Row, alone, seconds_a_call, side_by_side
from filters import make_filter, run
from filters.wrappers.envs import EstimateState
from thruster_env.auv.dynamics import motion_substep
from thruster_env.auv.parameters import Constants as VehicleConstants
from thruster_env.auv.plant import make_plant as make_vehicle
from thruster_env.core.compiled import FASTMATH, with_callees
from thruster_env.core.parallel import spread
from thruster_env.core.sources import written_out
from thruster_env.core.streams import ACTION_SPACE, derived_seed
from thruster_env.env.copies import LANES, WIDTH
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import OF_COPIES, Place, callable_of, program_of
from thruster_env.model.affine import AffineModel
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import traced_function
from thruster_env.thruster.dynamics import Constants, substep, thrust_and_torque
from thruster_env.thruster.model import thruster_model
from thruster_env.thruster.plant import Plant, make_plant
from tuning.plants.auv import find_scenario
from tuning.problems.data import training_seeds

ENSEMBLE_SIZE = 50
HORIZON, HORIZON_GOAL = 10, 1 / 10
PEER_STEPS = 100  # of FilterPy's slow filters in a round; their time a step does not depend on their number
COPIES, STEPS = 8192, 200
PROPAGATED = 65536
FILTERED_COPIES, FILTERED_STEPS = 1024, 100


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    voltages, measurements = recorded_episode(seed)
    plant = gym.make("BowThruster-v0").unwrapped.plant
    kalman = EstimateState(gym.make("BowThruster-v0"), filter="kf")

    ours, peer = episode(gym.make("BowThruster-v0"), seed), episode(gym.make("Pendulum-v1"), seed)
    timing = side_by_side(ours, peer, 20 if quick else 600)
    yield Row("env step", "Pendulum-v1", timing, ratio_goal=0.29)

    for model, peer_name, goal in (
        (python_model, "FilterPy", 1 / 40),
        (compiled_model, "FilterPy with numba", None),
    ):
        wrapped = EstimateState(gym.make("BowThruster-v0"), filter="enkf", ensemble_size=ENSEMBLE_SIZE)
        peer = peer_ensemble(plant, model, voltages, measurements, seed)
        timing = side_by_side(episode(wrapped, seed), peer, 4 if quick else 60)
        yield Row(f"EnKF step, N = {ENSEMBLE_SIZE}", peer_name, timing, ratio_goal=goal)

    for name in ("kf", "ekf"):
        wrapped = EstimateState(gym.make("BowThruster-v0"), filter=name)
        step = KalmanStep(kalman.filter.kernel_model)
        inputs = np.column_stack([voltages, np.ones_like(voltages)])
        peer = seconds_a_call(step, zip(inputs, measurements, strict=True), step.reset)
        timing = side_by_side(episode(wrapped, seed), peer, 10 if quick else 200)
        yield Row(f"{name.upper()} step", "FilterPy's KF", timing, ratio_goal=0.31)

    wrapped = EstimateState(gym.make("BowThruster-v0"), filter="ukf")
    points = wrapped.filter.alpha, wrapped.filter.beta, wrapped.filter.kappa
    step = UnscentedStep(plant, points, python_model)
    recorded = zip(voltages[:PEER_STEPS].tolist(), measurements[:PEER_STEPS], strict=True)
    peer = seconds_a_call(step, recorded, step.reset)
    timing = side_by_side(episode(wrapped, seed), peer, 10 if quick else 100)
    yield Row("UKF step", "FilterPy's UKF", timing, ratio_goal=1 / 10)


def recorded_episode(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Voltages (K,) and measurements (K, 1) of an episode, for filters that run beside no env."""
    env = gym.make("BowThruster-v0")
    env.reset(seed=seed)
    actions = _actions(env, seed)
    measurements = [env.step(action)[-1]["measurement"] for action in actions]
    return np.array(actions, dtype=np.float64)[:, 0], np.array(measurements)


def episode(env: gym.Env, seed: int) -> Measure:
    """A measure of one step: a whole episode under random actions; the reset is not timed."""
    env.reset(seed=seed)
    return seconds_a_call(env.step, [(action,) for action in _actions(env, seed)], env.reset)


def _actions(env: gym.Env, seed: int) -> list[np.ndarray]:
    env.action_space.seed(derived_seed(seed, ACTION_SPACE))
    return [env.action_space.sample() for _ in range(env.spec.max_episode_steps)]


def peer_ensemble(plant: Plant, model, voltages, measurements, seed: int) -> Measure:
    """A measure of one predict and update of FilterPy's ensemble Kalman filter."""
    np.random.seed(seed)  # FilterPy draws from the global generator
    step = EnsembleStep(plant, ENSEMBLE_SIZE, model)
    recorded = zip(voltages[:PEER_STEPS].tolist(), measurements[:PEER_STEPS], strict=True)
    return seconds_a_call(step, recorded, step.reset)


def horizon_rows(seed: int, quick: bool) -> Iterator[Row]:
    """The step, beside do-mpc's where that is installed."""
    wrapped = EstimateState(gym.make("BowThruster-v0"), filter="mhe", horizon=HORIZON, loss="quadratic")
    ours, what = episode(wrapped, seed), f"MHE step, L = {HORIZON}"
    if find_spec("do_mpc") is None:
        yield Row(what, None, alone(ours, 4 if quick else 40))
        return
    step, reset = do_mpc_step(thruster_model())
    voltages, measurements = recorded_episode(seed)
    recorded = list(zip(voltages[:PEER_STEPS].tolist(), measurements[:PEER_STEPS, 0].tolist(), strict=True))
    peer = seconds_a_call(step, recorded, reset)
    yield Row(what, "do-mpc", side_by_side(ours, peer, 2 if quick else 10), ratio_goal=HORIZON_GOAL)


def do_mpc_step(model: StateSpaceModel) -> tuple[Callable[[float, float], np.ndarray], Callable[[], None]]:
    """Functions step(u, z) and reset() of do-mpc's estimator of a model with one input and one channel."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of parts of do-mpc that are not installed
        import do_mpc
    import casadi

    logging.getLogger("do_mpc").setLevel(logging.ERROR)
    plant = do_mpc.model.Model("discrete", "SX")
    x, u = plant.set_variable("_x", "x", (model.n, 1)), plant.set_variable("_u", "u")
    propagated = tuple(casadi.vertsplit(x))
    for _ in range(model.substeps):
        propagated = model.transition(propagated, (u,), model.constants)
    plant.set_meas(
        "z", casadi.vertcat(*model.observe(tuple(casadi.vertsplit(x)), model.constants)), meas_noise=True
    )
    plant.set_meas("given", u, meas_noise=False)
    plant.set_rhs("x", casadi.vertcat(*propagated), process_noise=True)
    plant.setup()
    estimator = do_mpc.estimator.MHE(plant, [])
    estimator.settings.n_horizon, estimator.settings.t_step = HORIZON, 1.0
    estimator.settings.meas_from_data = True
    estimator.settings.supress_ipopt_output()
    weights = (
        np.linalg.inv(cov) for cov in (model.prior_cov, model.measurement_noise_cov, model.process_noise_cov)
    )
    prior, noise, disturbance = weights
    estimator.set_default_objective(P_x=prior, P_v=noise, P_w=disturbance)
    estimator.setup()

    def reset() -> None:
        estimator.reset_history()
        estimator.x0 = model.prior_mean
        estimator.set_initial_guess()

    def step(voltage: float, z: float) -> np.ndarray:
        return estimator.make_step(np.array([[z], [voltage]]))

    return step, reset


def vector_rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds = 5 if quick else 40
    ours, peer = vector_steps("BowThruster-v0", seed), vector_steps("CartPole-v1", seed)
    timing = side_by_side(ours, peer, rounds)
    yield Row(f"vector env, {COPIES} copies", "CartPole-v1", timing, ratio_goal=0.4)

    timing = alone(propagation(), rounds)
    yield Row(f"Runge-Kutta step, {PROPAGATED} copies", None, timing)


def memory_line() -> str:
    """Memory of a copy, in words."""
    env = gym.make_vec("BowThruster-v0", num_envs=COPIES)
    return f"Memory: {env.unwrapped.bytes_per_copy} bytes a copy of the vector env while it steps."


def vector_steps(name: str, seed: int, copies: int = COPIES, steps: int = STEPS, **arguments) -> Measure:
    """A measure of one copy's step in a vector env of many copies under random actions."""
    env = gym.make_vec(name, num_envs=copies, **arguments)
    env.action_space.seed(derived_seed(seed, ACTION_SPACE))
    actions = env.action_space.sample()

    def measure() -> float:
        env.reset(seed=seed)
        begin = perf_counter()
        for _ in range(steps):
            env.step(actions)
        return (perf_counter() - begin) / (steps * copies)

    return measure


def propagation() -> Measure:
    """A measure of one Runge-Kutta step of one copy without noise, many copies on all cores."""
    constants, states = np.array(make_plant().constants), np.zeros((PROPAGATED // WIDTH, 2, WIDTH))
    move, calls = _propagate(), 20

    def measure() -> float:
        begin = perf_counter()
        spread(lambda first, last: move(states, constants, calls, first, last), len(states))
        return (perf_counter() - begin) / (calls * PROPAGATED)

    return measure


_constants = written_out(
    "constants",
    "numbers",
    f"Constants({', '.join(f'numbers[{i}]' for i in range(len(Constants._fields)))})",
    Constants=Constants,
)


@cache
def _propagate() -> Callable:

    def propagate(states, numbers, calls, first, last):
        c = _constants(numbers)
        for b in range(first, last):
            for _ in range(calls):
                for j in range(states.shape[2]):
                    states[b, 0, j], states[b, 1, j] = substep((states[b, 0, j], states[b, 1, j]), (12.0, 0.0), c)

    return Loops(propagate)


def vector_filter_rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    sized = {"filter_arguments": {"ensemble_size": ENSEMBLE_SIZE}}
    for what, name, arguments in (
        ("EKF", "filters:BowThruster-EKF-v0", {}),
        (f"EnKF, N = {ENSEMBLE_SIZE},", "filters:BowThruster-EnKF-v0", sized),
    ):
        measure = vector_steps(name, seed, FILTERED_COPIES, FILTERED_STEPS, **arguments)
        timing = alone(measure, 5 if quick else 40)
        yield Row(f"{what} on {FILTERED_COPIES} copies", None, timing)


def python_model(plant: Plant) -> tuple[list[float], Callable, Callable]:
    """The plant as FilterPy's fx and hx, on plain floats, which Python handles faster than small arrays.

    Returns the input [V_s, U_0], to be set before each step since fx takes none, then fx and hx.
    """
    u, c, substeps = [0.0, plant.ambient_velocity], plant.constants, plant.substeps

    def fx(x, dt):
        x = x.tolist()
        for _ in range(substeps):
            x = substep(x, u, c)
        return x

    def hx(x):
        return thrust_and_torque(x.tolist(), c)[0]

    return u, fx, hx


def compiled_model(plant: Plant) -> tuple[list[float], Callable, Callable]:
    """The same compiled, a member a call: the most that a user of FilterPy can do without leaving it."""
    u, numbers, substeps = [0.0, plant.ambient_velocity], np.array(plant.constants), plant.substeps
    advance, thrust = _compiled_functions()

    def fx(x, dt):
        return advance(x, u[0], numbers, substeps)

    def hx(x):
        return thrust(x, numbers)

    return u, fx, hx


def _by_numba(function: Callable) -> Callable:
    import numba
    from numba.extending import register_jitable

    for part in with_callees([function]):
        if part is not function:
            register_jitable(part)
    return numba.njit(fastmath=set(FASTMATH), error_model="numpy")(function)


@cache
def _compiled_functions() -> tuple[Callable, Callable]:

    def advance(x, voltage, numbers, substeps):
        c = _constants(numbers)
        state = (x[0], x[1])
        for _ in range(substeps):
            state = substep(state, (voltage, c.ambient_velocity), c)
        return state

    def thrust(x, numbers):
        return thrust_and_torque((x[0], x[1]), _constants(numbers))[0]

    return _by_numba(advance), _by_numba(thrust)


class EnsembleStep:
    """One predict and update of FilterPy's ensemble Kalman filter under a voltage."""

    def __init__(self, plant: Plant, ensemble_size: int, model: Callable):
        """Make the filter; model is `python_model` or `compiled_model`."""
        self._u, fx, hx = model(plant)
        self._plant = plant
        self.filter = EnsembleKalmanFilter(
            plant.initial_mean, plant.initial_cov, 1, plant.dt, ensemble_size, hx, fx
        )
        self.filter.Q, self.filter.R = plant.process_noise_cov, plant.measurement_noise_cov

    def reset(self) -> None:
        """Put the prior back, with members from NumPy's global generator."""
        self.filter.initialize(self._plant.initial_mean, self._plant.initial_cov)

    def __call__(self, voltage: float, z: np.ndarray) -> None:
        """Do the step."""
        self._u[0] = voltage
        self.filter.predict()
        self.filter.update(z)


class UnscentedStep:
    """One predict and update of FilterPy's unscented Kalman filter under a voltage."""

    def __init__(self, plant: Plant, points: tuple[float, float, float], model: Callable):
        """Make the filter; points are (alpha, beta, kappa), model is `python_model` or `compiled_model`."""
        self._u, fx, hx = model(plant)
        self._plant = plant
        sigma_points = MerweScaledSigmaPoints(2, *points)
        self.filter = UnscentedKalmanFilter(2, 1, plant.dt, lambda x: [hx(x)], fx, sigma_points)
        self.filter.Q, self.filter.R = plant.process_noise_cov, plant.measurement_noise_cov
        self.reset()

    def reset(self) -> None:
        """Put the prior back."""
        self.filter.x, self.filter.P = self._plant.initial_mean, self._plant.initial_cov

    def __call__(self, voltage: float, z: np.ndarray) -> None:
        """Do the step."""
        self._u[0] = voltage
        self.filter.predict()
        self.filter.update(z)


class KalmanStep:
    """One predict and update of FilterPy's Kalman filter of an affine model under a voltage."""

    def __init__(self, model: AffineModel):
        """Make the filter; offsets go in as a second, constant input, and off the measurement."""
        a, b, offset, c, self._shift = model.matrices()
        self.filter = KalmanFilter(dim_x=model.n, dim_z=model.m, dim_u=2)
        self.filter.F, self.filter.B, self.filter.H = a, np.column_stack([b, offset]), c
        self.filter.Q, self.filter.R = model.process_noise_cov, model.measurement_noise_cov
        self._model = model
        self.reset()

    def reset(self) -> None:
        """Put the prior back."""
        self.filter.x, self.filter.P = self._model.prior_mean, self._model.prior_cov

    def __call__(self, u: np.ndarray, z: np.ndarray) -> None:
        """Do the step under u = (V_s, 1)."""
        self.filter.predict(u)
        self.filter.update(z - self._shift)


MEMBERS, MEMBER_STEPS = 256, 200
VEHICLES, VECTOR_STEPS = 1024, 50
PAPER_SIZE, PAPER_SECONDS = 300, 25.0
CRUISE = (2.845, -0.01707, 0.0, 0.0)  # propeller's force [N] and torque [N m], both rudders [rad]
N = 8  # states of the model "motion"
PAIRS = 8  # of a sine and a cosine in a Runge-Kutta step: four rates of roll and pitch


def vehicle_rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    step, sines = member_steps(), library_sines()
    timing = side_by_side(step, sines, 20 if quick else 200)  # milliseconds each
    what = f"vehicle, {N} states: member's step"
    yield Row(what, "library sines alone", timing, ratio_goal=0.27)

    sensors = {"sensors": "motion"}
    filtered = vector_steps("filters:SegorogeniAUV-EKF-v0", seed, VEHICLES, VECTOR_STEPS, **sensors)
    bare = vector_steps("SegorogeniAUV-v0", seed, VEHICLES, VECTOR_STEPS, **sensors)
    timing = side_by_side(filtered, bare, 3 if quick else 20)
    what = f"EKF of {N} states on {VEHICLES} vehicles"
    yield Row(what, "vehicles alone", timing)

    timing = alone(papers_ensemble(seed), 1 if quick else 5, warm_up=False)
    what = f"EnKF, {N} states, N = {PAPER_SIZE}, 25 s at 1 kHz"
    yield Row(what, None, timing)


def member_steps() -> Measure:
    """A measure of one member's Runge-Kutta step of 0.05 s at a cruise, on one core."""
    plant = make_vehicle()
    table = np.zeros((N, MEMBERS))
    table[0], numbers = 1.0, np.array(plant.constants)
    propagate = _motion(plant.constants)
    return shared(lambda: propagate(table, MEMBER_STEPS, numbers), MEMBER_STEPS * MEMBERS)


def library_sines() -> Measure:
    """A measure of the sines and cosines of one member's step as the mathematical library gives them."""
    angles, evaluate = np.linspace(-0.1, 0.1, MEMBERS), _sines()
    return shared(lambda: evaluate(angles, MEMBER_STEPS), MEMBER_STEPS * MEMBERS)


def papers_ensemble(seed: int) -> Measure:
    """A measure of one run of an ensemble over 25 s of path IV at 1 kHz; the truth is made before."""
    scenario = find_scenario("auv:papers").replace(steps=round(PAPER_SECONDS / 0.001))
    filter_ = make_filter("enkf", scenario.model(**scenario.true), ensemble_size=PAPER_SIZE)
    data = scenario.data(training_seeds(seed, 2))
    first = (data.filter_keys[:1], data.inputs[:1], data.measurements[:1])
    begin = (first[0], first[1][:, :10], first[2][:, :11])
    run(filter_, *begin)  # compiles

    def measure() -> float:
        started = perf_counter()
        run(filter_, *first)
        return perf_counter() - started

    return measure


def _motion(constants: VehicleConstants) -> Callable:
    """`propagate(table, steps, numbers)` of members (N, columns), with the motion traced as envs trace it."""
    graph, sizes = Graph(), (N, len(CRUISE), len(constants))
    x = [graph.given(Place("memory", k)) for k in range(N)]
    c = [graph.given(Place("numbers", k)) for k in range(len(constants))]
    motion = traced_function(motion_substep, sizes, type(constants), (N,))
    after = motion(*(np.array(part, dtype=object) for part in (x, CRUISE, c)))
    stores = [(Place("memory", k), graph.number(entry)) for k, entry in enumerate(after)]
    step = callable_of(program_of(stores, {}), LANES, OF_COPIES)

    def propagate(table, steps, numbers):
        for _ in range(steps):
            for j in range(0, table.shape[1], LANES):
                step(table[:, j : j + LANES], numbers)

    return Loops(propagate)


@cache
def _sines() -> Callable:
    def evaluate(angles, repeats):
        for _ in range(repeats):
            for j in range(angles.shape[0]):
                total = 0.0
                for k in range(PAIRS):
                    x = angles[j] + 0.01 * k
                    total += math.sin(x) * math.cos(x)
                angles[j] = 0.1 * total / PAIRS  # so that each round depends on the last

    return Loops(evaluate)
