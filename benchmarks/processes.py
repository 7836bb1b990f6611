"""What a fresh process waits for: imports, and the first call of compiled code that lies in the cache."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator

from benchmarks.timing import Measure, Row, side_by_side

FIRST_STEP = """
env = gymnasium.make("BowThruster-v0")
env.reset(seed=0)
env.step(env.action_space.high)
"""
TUNING_IMPORTS = """
from tuning.evaluation.evaluate import evaluate
from tuning.thruster.scenario import find_scenario
from tuning.problems.seeds import training_seeds
from tuning.search.space import oracle_choice
"""
FIRST_EVALUATION = """
scenario = find_scenario("nominal")
data = scenario.data(training_seeds({seed}, 64))
evaluate(oracle_choice("enkf", scenario).with_size(50).filter(scenario), data, scenario.scale)
"""


FIRST_FILTER = """
import gymnasium
env = gymnasium.make("filters:BowThruster-EKF-v0")
env.reset(seed=0)
env.step(env.action_space.high)
"""
SMALL_FUNCTION = """
import numba, numpy
@numba.njit
def square_sum(x):
    total = 0.0
    for i in range(x.shape[0]):
        total += x[i] * x[i]
    return total
square_sum(numpy.ones(3))
"""
IMPORT_GOAL, STEP_GOAL = 2.6, 5.7  # of the time that Gymnasium's import takes, and that of numba's
EVALUATE_GOAL, COLD_GOAL = 0.6, 5.0  # [s]; a user waits for these, on whatever machine


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other; whoever calls this has run, and so compiled, all that is measured."""
    rounds = 1 if quick else 7
    ours, gymnasium = in_a_process("import thruster_env"), in_a_process("import gymnasium")
    timing = side_by_side(ours, gymnasium, rounds, warm_up=False)
    yield Row("import thruster_env", "import gymnasium", timing, ratio_goal=IMPORT_GOAL)
    numba = in_a_process("import numba", "import gymnasium")
    first = in_a_process(FIRST_STEP, "import gymnasium, thruster_env")
    timing = side_by_side(first, numba, rounds, warm_up=False)
    yield Row("first make, reset and step", "import numba", timing, ratio_goal=STEP_GOAL)
    first = in_a_process(FIRST_EVALUATION.format(seed=seed), TUNING_IMPORTS)
    timing = side_by_side(first, numba, rounds, warm_up=False)
    yield Row("first evaluate", "import numba", timing, time_goal=EVALUATE_GOAL)
    cold, small = processor_time(FIRST_FILTER), processor_time(SMALL_FUNCTION)
    timing = side_by_side(cold, small, 1 if quick else 3, warm_up=False)
    yield Row("cold first use of the EKF, processor time", "numba on one loop", timing, time_goal=COLD_GOAL)


def in_a_process(timed: str, before: str = "") -> Measure:
    """A measure of the seconds that source text takes in a fresh interpreter, after other, untimed text."""
    source = "\n".join(
        [
            before,
            "from time import perf_counter",
            "begin = perf_counter()",
            timed,
            "print(perf_counter() - begin)",
        ]
    )

    def measure() -> float:
        done = subprocess.run([sys.executable, "-c", source], check=True, stdout=subprocess.PIPE, text=True)
        return float(done.stdout.splitlines()[-1])

    return measure


def processor_time(source: str) -> Measure:
    """A measure of the processor time [s] of a fresh interpreter that runs a source, with no machine code kept."""

    def measure() -> float:
        with tempfile.TemporaryDirectory() as folder:
            environment, begin = {**os.environ, "NUMBA_CACHE_DIR": folder}, os.times()
            subprocess.run([sys.executable, "-c", source], check=True, env=environment)
            end = os.times()
        return end.children_user + end.children_system - begin.children_user - begin.children_system

    return measure
