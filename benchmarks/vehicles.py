"""Underwater vehicles: the member's Runge-Kutta step, a filter on each of a thousand, the papers' ensemble."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache
from time import perf_counter

import numpy as np

from benchmarks.batches import shared
from benchmarks.steps import vector_steps
from benchmarks.timing import Measure, Row, alone, side_by_side
from filters import make_filter, run
from filters.filter import Filter
from thruster_env.auv.dynamics import motion_substep
from thruster_env.auv.parameters import Constants
from thruster_env.auv.plant import make_plant
from thruster_env.env.copies import LANES
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import OF_COPIES, Place, callable_of, program_of
from thruster_env.model.traced import traced_function
from tuning.plants.auv import Scenario, find_scenario
from tuning.problems.data import training_seeds

MEMBERS, STEPS = 256, 200
COPIES, VECTOR_STEPS = 1024, 50
PAPER_SIZE, PAPER_SECONDS = 300, 25.0
CRUISE = (2.845, -0.01707, 0.0, 0.0)  # propeller's force [N] and torque [N m], both rudders [rad]
N = 8  # states of the model "motion"
PAIRS = 8  # of a sine and a cosine in a Runge-Kutta step: four rates of roll and pitch


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    step, sines = member_steps(), library_sines()
    timing = side_by_side(step, sines, 20 if quick else 200)  # milliseconds each
    what = f"vehicle, {N} states: member's step"
    yield Row(what, "library sines alone", timing, ratio_goal=0.27)

    sensors = {"sensors": "motion"}
    filtered = vector_steps("filters:SegorogeniAUV-EKF-v0", seed, COPIES, VECTOR_STEPS, **sensors)
    bare = vector_steps("SegorogeniAUV-v0", seed, COPIES, VECTOR_STEPS, **sensors)
    timing = side_by_side(filtered, bare, 3 if quick else 20)
    what = f"EKF of {N} states on {COPIES} vehicles"
    yield Row(what, "vehicles alone", timing)

    timing = alone(papers_ensemble(seed), 1 if quick else 5, warm_up=False)
    what = f"EnKF, {N} states, N = {PAPER_SIZE}, 25 s at 1 kHz"
    yield Row(what, None, timing)


def member_steps() -> Measure:
    """A measure of one member's Runge-Kutta step of 0.05 s at a cruise, on one core."""
    plant = make_plant()
    table = np.zeros((N, MEMBERS))
    table[0], numbers = 1.0, np.array(plant.constants)
    propagate = _propagator(plant.constants)
    return shared(lambda: propagate(table, STEPS, numbers), STEPS * MEMBERS)


def library_sines() -> Measure:
    """A measure of the sines and cosines of one member's step as the mathematical library gives them."""
    angles, evaluate = np.linspace(-0.1, 0.1, MEMBERS), _sines()
    return shared(lambda: evaluate(angles, STEPS), STEPS * MEMBERS)


def papers_filter() -> tuple[Filter, Scenario]:
    """The papers' ensemble and its scenario."""
    scenario = find_scenario("auv:papers").replace(steps=round(PAPER_SECONDS / 0.001))
    return make_filter("enkf", scenario.model(**scenario.true), ensemble_size=PAPER_SIZE), scenario


def papers_ensemble(seed: int) -> Measure:
    """A measure of one run of an ensemble over 25 s of path IV at 1 kHz; the truth is made before."""
    filter_, scenario = papers_filter()
    data = scenario.data(training_seeds(seed, 2))
    first = (data.filter_keys[:1], data.inputs[:1], data.measurements[:1])
    begin = (first[0], first[1][:, :10], first[2][:, :11])
    run(filter_, *begin)  # compiles

    def measure() -> float:
        started = perf_counter()
        run(filter_, *first)
        return perf_counter() - started

    return measure


def _propagator(constants: Constants) -> Callable:
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
