"""What held under attack: angles about any heading, missing samples, bands of NIS, processes, forms of tables."""

import asyncio
import itertools
import math
import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from filters import FILTERS, EstimateState, make_filter, run
from filters.logs.estimate import LogEstimate
from filters.logs.findings import findings
from tests.filters.test_filter_paths import assert_paths_agree
from tests.models import KEY, line_model, scalar_model, simulated, small
from tests.slow import slow_but
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import filter_keys
from thruster_env.env.model_env import ReplayEnv
from thruster_env.logs.log import Log
from thruster_env.logs.read import read_log

LOGS, LEVEL = 600, 3.9  # deviations that a binomial share stays within, but once in 10 000 seeds


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", FILTERS)
def test_with_a_fifth_of_all_samples_missing_all_paths_agree(name):
    model, steps = line_model(), 30
    inputs, measurements = simulated(model, steps)
    measurements[np.random.default_rng(5).random(measurements.shape) < 0.2] = np.nan
    assert 3 <= np.isnan(measurements).sum() <= 12
    filter_ = small(name, model)
    assert_paths_agree(filter_, KEY, inputs, measurements)
    log = Log("run", 0.1, inputs[0], measurements[0], model.input_quantities, model.measurements)
    env = EstimateState(ReplayEnv(log, model), filter=filter_)
    infos = [env.reset(seed=3)[1]] + [env.step(np.zeros(model.inputs))[-1] for _ in range(steps)]
    batch = run(filter_, filter_keys([3]), inputs, measurements)
    for part, key in ((batch.means, "estimate"), (batch.covs, "estimate_cov"), (batch.innovations, "innovation")):
        np.testing.assert_allclose([info[key] for info in infos], part[0], rtol=5e-13, atol=5e-13)


@pytest.mark.slow
def test_the_band_of_the_mean_nis_holds_95_percent_of_logs():
    model, steps = scalar_model(), 60
    rng, inputs, x = np.random.default_rng(8), np.zeros((LOGS, steps, 1)), np.empty((LOGS, steps + 1, 1))
    x[:, 0] = 3.0 + rng.normal(scale=0.5**0.5, size=(LOGS, 1))
    for k in range(steps):
        x[:, k + 1] = 0.9 * x[:, k] + rng.normal(scale=0.1**0.5, size=(LOGS, 1))
    measurements = 2.0 * x + rng.normal(scale=0.2**0.5, size=x.shape)
    measurements[np.random.default_rng(1).random(measurements.shape) < 0.2] = np.nan
    filter_ = make_filter("kf", model)
    found = run(filter_, filter_keys(range(LOGS)), inputs, measurements)
    inside = 0
    for i in range(LOGS):
        log = Log("run", 0.1, inputs[i], measurements[i], model.input_quantities, model.measurements)
        v = np.where(np.isnan(measurements[i]), np.nan, found.innovations[i])
        parts = found.means[i], found.covs[i], v, found.innovation_covs[i], found.log_likelihoods[i], 0
        told = findings(LogEstimate(log, filter_, *parts, False), skip=0)
        low, high = told.nis_band
        inside += low <= told.mean_nis <= high
    assert abs(inside / LOGS - 0.95) < LEVEL * math.sqrt(0.95 * 0.05 / LOGS)


def means_of(seed):
    """The estimates of some runs of an ensemble, as any process or thread computes them."""
    model = scalar_model()
    with interpreted():
        inputs, measurements = simulated(model, 8, count=2, seed=seed)
        return run(make_filter("enkf", model, ensemble_size=6), filter_keys([seed, 9]), inputs, measurements).means


@pytest.mark.parametrize("way", slow_but(["fork", "spawn"], ["fork"]))
def test_another_process_finds_the_same_numbers(way):
    if way not in multiprocessing.get_all_start_methods():
        pytest.skip(f"there is no {way} here")
    with multiprocessing.get_context(way).Pool(1) as pool:
        np.testing.assert_array_equal(pool.apply(means_of, (3,)), means_of(3))


def test_threads_and_tasks_find_the_same_numbers():
    inputs, measurements = simulated(scalar_model(), 8, count=2, seed=3)
    filter_ = make_filter("enkf", scalar_model(), ensemble_size=6)

    def means(seed):
        return run(filter_, filter_keys([seed, 9]), inputs, measurements).means

    alone = [means(seed) for seed in range(6)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(means, range(6)))

    async def together():
        return await asyncio.gather(*(asyncio.to_thread(means, seed) for seed in range(6)))

    for one, other, third in zip(alone, found, asyncio.run(together()), strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(one, third)


TABLES = list(
    itertools.product(
        [",", ";", "\t"],
        ["\n", "\r\n"],
        ["", "\ufeff"],
        ["t{s}V_s{s}tach", "time [s]{s}voltage{s}tach (rad/s)", "time_s{s}V_s_V{s}tach_rad_per_s"],
        ["", "nan"],
    )
)


def test_fifty_forms_of_a_table_are_the_same_log(tmp_path):
    assert len(TABLES) > 50
    for place, (mark, end, begin, header, gap) in enumerate(TABLES):
        rows = [[0.1 * k, 2.0 * k, 0.5 * k] for k in range(6)]
        cells = [[f"{t:g}", f"{v:g}", gap if k == 3 else f"{z:g}"] for k, (t, v, z) in enumerate(rows)]
        text = begin + end.join([header.format(s=mark), *(mark.join(row) for row in cells)]) + end
        path = tmp_path / f"{place}.csv"
        path.write_bytes(text.encode("utf-8"))
        log = read_log(path, MODEL)
        expected = [0.0, 0.5, 1.0, np.nan, 2.0, 2.5]
        np.testing.assert_array_equal(log.measurements[:, 0], expected, err_msg=repr(text))
        np.testing.assert_array_equal(log.inputs[:, 0], [0.0, 2.0, 4.0, 6.0, 8.0])
        assert (log.dt, log.start) == (0.1, 0.0)
