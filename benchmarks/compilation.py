"""What the first use of each filter costs, in processor time and memory, by the size of the model.

`python -m benchmarks.compilation` prints a table in Markdown, that of docs/size.md. Every filter is measured in a
process of its own with an empty cache. A size and names of filters as arguments are measured in this process.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time

import numpy as np

from filters import affine_model, make_filter
from filters.filter import Filter
from filters.registry import FILTERS, filter_type
from thruster_env.model.state_space import StateSpaceModel

SIZES = ((2, 1), (12, 4), (40, 40))
ON_AFFINE = ("kf", "kf-steady", "fuzzy")  # they would approximate another model


def lorenz_96(x, u, c):
    """One step of Euler's method; c = (step, forcing)."""
    after = np.empty(len(x))
    for i in range(len(x)):
        after[i] = x[i] + c[0] * ((x[(i + 1) % len(x)] - x[i - 2]) * x[i - 1] - x[i] + c[1])
    return after


def first_states(count: int):
    """Return h(x) = the first `count` states."""

    def observe(x, c):
        observed = np.empty(count)
        for i in range(count):
            observed[i] = x[i]
        return observed

    return observe


def model_of(name: str, n: int, m: int) -> StateSpaceModel:
    """A model of n states and m measurements for a filter."""
    noise = {"process_noise_cov": np.full(n, 0.1), "measurement_noise_cov": np.full(m, 0.5)}
    prior = {"prior_mean": np.zeros(n), "prior_cov": np.ones(n)}
    if name in ON_AFFINE:
        return affine_model(a=0.9 * np.eye(n), b=np.ones((n, 1)), c=np.eye(m, n), **noise, **prior)
    return StateSpaceModel(transition=lorenz_96, observe=first_states(m), constants=(0.01, 8.0), **noise, **prior)


def use_once(filter_: Filter) -> None:
    """Begin, predict, and update."""
    belief = filter_.predict(filter_.init(), np.zeros(filter_.model.inputs))
    filter_.update(belief, np.zeros(filter_.model.m))


def filter_of(name: str, n: int, m: int) -> Filter:
    """A filter on a model of n states and m measurements."""
    numbers = {"ensemble_size": 10} if filter_type(name).has_ensemble else {}
    return make_filter(name, model_of(name, n, m), **numbers)


def timed_use(filter_: Filter) -> tuple[float, float]:
    """Processor time [s] and growth of memory [MB] of a filter's first use."""
    memory, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    use_once(filter_)
    spent = time.process_time() - begin
    return spent, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1024


def measured(module: str, *arguments: str) -> tuple[float, float]:
    """What a module prints of `timed_use` in a process of its own, whose cache is empty."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", module, *arguments]
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return tuple(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Print the table, or one measurement."""
    if len(sys.argv) > 1:
        n, m, *names = sys.argv[1:]
        for name in names:
            print(json.dumps(timed_use(filter_of(name, int(n), int(m)))), flush=True)
        return
    print("| filter | " + " | ".join(f"n = {n}, m = {m}" for n, m in SIZES) + " |")
    print("|---|" + "--:|" * len(SIZES))
    for name in FILTERS:
        cells = (
            f"{seconds:.1f} s, {megabytes:.0f} MB"
            for seconds, megabytes in (measured(__spec__.name, str(n), str(m), name) for n, m in SIZES)
        )
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
