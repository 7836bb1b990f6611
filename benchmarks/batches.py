"""Whole evaluations on all cores, per member and step, beside the least arithmetic that they need."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from time import perf_counter

import numpy as np

from benchmarks.rates import arithmetic_limit, normals, operations_of, step_of_filter, times
from benchmarks.timing import Measure, Row, alone, side_by_side
from filters import run
from thruster_env.core.compiled import compiled, function_fingerprint
from thruster_env.core.sources import column_reader, column_writer, vector_reader
from thruster_env.core.streams import FILTER_PROCESS, fill_normals
from thruster_env.core.threads import cores, spread
from thruster_env.thruster.dynamics import Constants, substep
from thruster_env.thruster.plant import Plant
from tuning.evaluation.evaluate import evaluate
from tuning.problems.seeds import training_seeds
from tuning.search.space import Choice, oracle_choice
from tuning.thruster.scenario import find_scenario

SEEDS, ENSEMBLE_SIZE = 64, 50
EVALUATE_GOAL, RUN_GOAL = 2.1, 1.8  # of the floor's time
NORMALS = 3  # a member and step: one for each state, one for the measurement
WIDTH = 64  # members in one block of the floor: whole vector registers, and all in the fastest cache
BLOCKS = SEEDS * ENSEMBLE_SIZE // WIDTH

_read_constants = vector_reader(len(Constants._fields))
_column, _store = column_reader(2), column_writer(2)


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds = 5 if quick else 60
    scenario = find_scenario("nominal")
    data = scenario.data(training_seeds(seed, SEEDS))
    choice = oracle_choice("enkf", scenario).with_size(ENSEMBLE_SIZE)
    count = SEEDS * scenario.steps * ENSEMBLE_SIZE

    def compute_metrics():
        evaluate(choice.filter(scenario), data, scenario.scale)

    a_step = times(step_of_filter(choice.filter(scenario)), 1 / ENSEMBLE_SIZE)
    limit = arithmetic_limit(a_step, cores=cores())
    floor = floor_measures(scenario.plant, scenario.steps)
    whole_floor = _sum(*floor.values())
    workload = f"{SEEDS} seeds, N = {ENSEMBLE_SIZE}"
    timing = side_by_side(shared(compute_metrics, count), whole_floor, rounds)
    yield Row(f"evaluate, {workload}", "floor", timing, ratio_goal=EVALUATE_GOAL, limit=limit)
    timing = side_by_side(shared(lambda: _run(choice, scenario, data), count), whole_floor, rounds)
    yield Row("the same without metrics", "floor", timing, ratio_goal=RUN_GOAL, limit=limit)
    for (name, measure), count in zip(floor.items(), floor_operations(scenario.plant), strict=True):
        limit = arithmetic_limit(count, cores=cores())
        yield Row(f"floor: {name}", None, alone(measure, rounds), limit=limit)


def _run(choice: Choice, scenario, data) -> None:
    run(choice.filter(scenario), data.filter_keys, data.inputs, data.measurements)


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


def floor_operations(plant: Plant) -> tuple[Counter[str], Counter[str]]:
    """Operations of the same: of the motion, and of the noise."""
    motion = operations_of(substep, np.zeros(2), (12.0, plant.ambient_velocity), plant.constants)
    return times(motion, plant.substeps), normals(NORMALS)


@cache
def _floor_functions() -> tuple[Callable, Callable]:
    fingerprint = function_fingerprint(within=__name__)

    def propagate(table, steps, substeps, numbers):
        fingerprint  # noqa: B018 - part of the cache's key
        c = Constants(*_read_constants(numbers))
        for _ in range(steps):
            for _ in range(substeps):
                for j in range(table.shape[1]):
                    _store(table, j, substep(_column(table, j), (12.0, c.ambient_velocity), c))

    def draw(draws, steps, key):
        fingerprint  # noqa: B018 - part of the cache's key
        for step in range(steps):
            fill_normals(draws, draws.shape[0], step, FILTER_PROCESS, key, 0)

    return compiled(propagate), compiled(draw)
