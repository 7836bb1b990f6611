"""What a fresh process waits for: imports, and the first call of compiled code that lies in the cache."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

from benchmarks.rows import Row
from benchmarks.timing import Measure, alone, side_by_side

FIRST_STEP = """
env = gymnasium.make("BowThruster-v0")
env.reset(seed=0)
env.step(env.action_space.high)
"""
TUNING_IMPORTS = """
from tuning.evaluation.evaluate import evaluate
from tuning.thruster.find import find_scenario
from tuning.problems.seeds import training_seeds
from tuning.search.space import oracle_choice
"""
FIRST_EVALUATION = """
scenario = find_scenario("nominal")
data = scenario.data(training_seeds({seed}, 64))
evaluate(oracle_choice("enkf", scenario).with_size(50).filter(scenario), data, scenario.scale)
"""


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other; whoever calls this has run, and so compiled, all that is measured."""
    rounds = 1 if quick else 7
    ours, peer = in_a_process("import thruster_env"), in_a_process("import gymnasium")
    timing = side_by_side(ours, peer, rounds, warm_up=False)
    yield Row("import thruster_env", "gymnasium", timing, time_goal=0.5)
    first = in_a_process(FIRST_STEP, "import gymnasium, thruster_env")
    yield Row("first make, reset and step", None, alone(first, rounds, warm_up=False), time_goal=1.0)
    first = in_a_process(FIRST_EVALUATION.format(seed=seed), TUNING_IMPORTS)
    yield Row("first evaluate", None, alone(first, rounds, warm_up=False))


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
