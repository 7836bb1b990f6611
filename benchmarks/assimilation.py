"""A study on Lorenz-96, forty states: a hundred trials of an EnKF, beside the same runs of DAPPER's.

DAPPER does not go with our versions of NumPy and SciPy, so it is run in an environment of its own: DAPPER_PYTHON
is the path of that one's interpreter. Without it there is no peer.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from time import perf_counter
from unittest import mock

import numpy as np

from benchmarks.rates import arithmetic_limit, step_by_size, times
from benchmarks.timing import Row, Timing
from filters.engine.batch import run
from filters.filter import Filter
from thruster_env.core.threads import cores
from tuning.experiments.lorenz96 import STEPS, problem
from tuning.problems import data as in_parts
from tuning.search import parameters as filter_parameters
from tuning.search import plan as plans
from tuning.search.plan import Plan
from tuning.search.study import open_study, quiet_optuna, run_study

INTERPRETER = "DAPPER_PYTHON"
TRIALS, SEEDS, LARGEST = 100, 8, 60
FEW = 2, 4  # members that are counted: each has forty states, and takes a second
PEER_SIZES = (10, 35, 60)  # its time a run is a line over N
GOAL = 1 / 20
PEER = """
import json, sys
from time import perf_counter
import dapper.da_methods as methods
import dapper.tools.progressbar as bar
from dapper.mods.Lorenz96.sakov2008 import HMM
from dapper.tools.seeding import set_seed
bar.disable_progbar = True
HMM.tseq.Ko = int(sys.argv[1])
seconds = []
for size in [int(sys.argv[2])] + [int(size) for size in sys.argv[2:]]:
    set_seed(3)
    truth, measurements = HMM.simulate()
    filter_ = methods.EnKF("PertObs", N=size, infl=1.06)
    begin = perf_counter()
    filter_.assimilate(HMM, truth, measurements, liveplots=False)
    filter_.stats.average_in_time()
    seconds.append(perf_counter() - begin)
print(json.dumps(seconds[1:]))
"""


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The study, and what DAPPER would take for its runs."""
    count, seeds = (3, 2) if quick else (TRIALS, SEEDS)
    ours, sizes, filter_ = study_seconds(seed, count, seeds)
    limit = filters_limit(filter_, sizes)
    what = f"study on Lorenz-96, {count} trials of an EnKF"
    if os.environ.get(INTERPRETER):
        peer = float(np.polyval(peer_line(100 if quick else STEPS), sizes).sum())
        yield Row(what, "DAPPER, extrapolated", Timing(ours, peer, ours / peer), ratio_goal=GOAL, limit=limit)
    else:
        yield Row(what, f"no DAPPER, {INTERPRETER} not set", Timing(ours, None, None), limit=limit)


def study_seconds(seed: int, count: int, seeds: int) -> tuple[float, list[int], Filter]:
    """Seconds of a study of so many trials on so many seeds, without pruning; the N of its runs; one filter."""
    quiet_optuna()
    few = mock.patch.multiple(plans, TRAINING_SEEDS=seeds, SIZE_SEEDS=seeds)
    limits = mock.patch.object(filter_parameters, "KALMAN_SIZES", filter_parameters.Sizes(30, 5, LARGEST))
    sizes: list[int] = []
    filters: list[Filter] = []

    def counting(filter_, keys, *data, **noise):
        sizes.extend([filter_.size] * len(keys))
        filters.append(filter_)
        return run(filter_, keys, *data, **noise)

    with few, limits, mock.patch.object(in_parts, "run", counting):
        plan = Plan("enkf", (problem,), seed, hold_r=True, prune=False)
        study = open_study("lorenz96", plan, None)
        plan.training_data()  # drawing the truth is no part of the study, nor of the peer's runs
        begin = perf_counter()
        run_study(study, plan, count)
        return perf_counter() - begin, sizes, filters[0]


def filters_limit(filter_: Filter, sizes: list[int]) -> float:
    """Seconds of runs of a filter with so many members on the arithmetic limit of all cores."""
    fixed, a_member = step_by_size(filter_, FEW)
    a_step = times(fixed, len(sizes)) + times(a_member, sum(sizes))
    return STEPS * arithmetic_limit(a_step, cores=cores())


def peer_line(steps: int) -> np.ndarray:
    """Slope and offset over N of the seconds that DAPPER takes for a run of 1000 analyses."""
    command = [os.environ[INTERPRETER], "-c", PEER, *map(str, (steps, *PEER_SIZES))]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    seconds = np.array(json.loads(done.stdout.splitlines()[-1])) * STEPS / steps
    return np.polyfit(PEER_SIZES, seconds, 1)
