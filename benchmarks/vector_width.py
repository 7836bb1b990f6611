"""The gain of vectors of 512 bits in code for an Intel server, where LLVM prefers 256 bits.

`python -m benchmarks.vector_width` prints a table in Markdown, that of docs/speed.md, in three minutes. Each width
is measured in processes of its own, in turns. A processor of another maker runs Intel's code too, if it has
AVX-512: that shows what the width does to the code, and not how quick an Intel processor is.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from functools import partial

import numpy as np

from benchmarks.batches import estimates, floor_measures, shared
from benchmarks.steps import vector_steps
from benchmarks.timing import Measure
from benchmarks.vehicles import member_steps
from thruster_env.core import optimising
from tuning.auv.scenario import find_scenario as find_vehicles
from tuning.problems.data import training_seeds
from tuning.search.space import oracle_choice
from tuning.thruster.scenario import find_scenario

TARGET = "emeraldrapids"
ROUNDS, REPEATS = 3, 15  # processes of each width, and measurements in each of which the best counts
SEEDS = 64
FILTERS = {"EKF": None, "UKF": None, "EnKF": 100, "ETKF": 100, "PF": 1000}  # with their ensembles
AGREEMENT = 1e-9  # of the estimates of a whole episode


def measures() -> tuple[dict[str, Measure], dict[str, float]]:
    """Measures of a step by name (of an ensemble, of a member's), and a number that tells each filter's result."""
    scenario, vehicles = find_scenario("nominal"), find_vehicles("auv:motion")
    data, on_vehicles = scenario.data(training_seeds(0, SEEDS)), vehicles.data(training_seeds(0, 2))
    measure_of, results = dict(floor_measures(scenario.plant, scenario.steps)), {}
    for name, size in FILTERS.items():
        choice = oracle_choice(name.lower(), scenario)
        filter_ = (choice.with_size(size) if size else choice).filter(scenario)
        label = f"{name} batch" + (f", N = {size}" if size else "")
        measure_of[label] = shared(partial(estimates, filter_, data), SEEDS * scenario.steps * (size or 1))
        results[label] = float(np.sum(np.abs(estimates(filter_, data))))
    measure_of["vector env, 8192 copies"] = vector_steps("BowThruster-v0", 0)
    measure_of["vehicle's Runge-Kutta step"] = member_steps()
    filter_ = oracle_choice("enkf", vehicles).with_size(100).filter(vehicles)
    count = 2 * vehicles.steps * 100
    measure_of["vehicle's EnKF batch, N = 100"] = shared(partial(estimates, filter_, on_vehicles), count)
    return measure_of, results


def measured(width: int, folder: str) -> tuple[dict[str, float], dict[str, float]]:
    """Nanoseconds of each measure, and the results, from a process whose code has vectors of a width [bits]."""
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    if not features.get("avx512f"):
        raise ValueError("vectors of 512 bits need a processor with AVX-512, and this one has none")
    target = {"NUMBA_CPU_NAME": TARGET, "NUMBA_CPU_FEATURES": features.flatten()}
    environment = {**os.environ, **target, "NUMBA_CACHE_DIR": f"{folder}/{width}"}
    command = [sys.executable, "-m", __spec__.name, str(width)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return tuple(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Print the table, or measurements."""
    if len(sys.argv) > 1:
        optimising.WIDE = f'"prefer-vector-width"="{int(sys.argv[1])}"'
        by_name, results = measures()
        times = {name: 1e9 * min(measure() for _ in range(REPEATS)) for name, measure in by_name.items()}
        print(json.dumps((times, results)))
        return
    times: dict[int, list[dict[str, float]]] = {256: [], 512: []}
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(ROUNDS):
            for width, rounds in times.items():
                by_name, result = measured(width, folder)
                rounds.append(by_name)
                results.append(result)
    for name, value in results[0].items():
        if any(abs(other[name] / value - 1.0) > AGREEMENT for other in results):
            raise ValueError(f"both widths must give the same estimates, but those of {name} differ")
    print("| a step | 256 bits | 512 bits | ratio |\n| --- | --- | --- | --- |")
    for name in times[256][0]:
        narrow, wide = (min(round_times[name] for round_times in times[width]) for width in (256, 512))
        print(f"| {name} | {narrow:.3g} ns | {wide:.3g} ns | {wide / narrow:.2f} |")


if __name__ == "__main__":
    main()
