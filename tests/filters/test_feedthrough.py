"""Measurements h(x, u, c): with h = g(x) + D u and z, every path gives what it gives of g and z - D u."""

import math
import re
import subprocess
from typing import NamedTuple

import numpy as np
import pytest

import filters
from filters import (
    FILTERS,
    EstimateState,
    EstimateStates,
    StateSpaceModel,
    augmented_model,
    make_filter,
    run,
    smooth,
    transformed_model,
)
from filters.bounds import posterior_bound
from filters.c.project import write_project
from filters.logs.estimate import estimate_with
from filters.logs.findings import findings, verdict
from filters.sensitivity import likelihood
from tests.filters.checks import refused
from tests.filters.test_c import WARNINGS, built, printed
from tests.oracles import each_close, each_equal
from tests.slow import slow_but
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.env.model_env import ModelEnv, ModelVectorEnv, ReplayEnv
from thruster_env.logs.log import in_any_steps
from thruster_env.logs.read import read_log
from thruster_env.logs.write import EXACT, write_columns, write_log
from thruster_env.model.affine import affine_model, linearize
from thruster_env.model.simulate import inputs_until, simulate
from tuning.likelihood.recorded import likelihood_of
from tuning.problems.log_problem import LogProblem, as_rows
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Coordinates, Parameter
from tuning.reporting.matlab import matlab_function
from tuning.search.space import untuned_choice

pytestmark = pytest.mark.usefixtures("as_python")

D = -2.0
NOISE = {
    "process_noise_cov": [0.01, 0.02],
    "measurement_noise_cov": [0.04],
    "prior_mean": [0.3, -0.2],
    "prior_cov": [0.5, 0.4],
}
MATRICES = {"a": [[0.9, 0.1], [0.0, 0.8]], "b": [[0.0, 1.0], [1.0, 0.0]], "c": [[1.0, 0.5]]}
ENSEMBLES = "ensembles", "particles"
RANGE = {"state_low": [-2, -2], "state_high": [2, 2]}
QUICK = ["kf", "ekf", "ukf", "enkf", "mhe", "gsf", "sage-husa", "inversion"]


class Constants(NamedTuple):
    dt: float = 0.1
    series: float = D


def move(x, u, c):
    return x[0] + c.dt * x[1], x[1] - c.dt * (x[1] + 0.3 * x[0] ** 3) + c.dt * u[0]


def g(x, c):
    return (x[0] + 0.1 * x[1] ** 2,)


def h(x, u, c):
    return (x[0] + 0.1 * x[1] ** 2 + c.series * u[0],)


def model(observe=h, **changes):
    arguments = {**NOISE, "inputs": 1, "operating_state": [0, 0], "operating_input": [0], **RANGE, **changes}
    return StateSpaceModel(transition=move, observe=observe, constants=Constants(), **arguments)


def data(runs=2, steps=12):
    inputs = np.random.default_rng(3).normal(size=(runs, steps, 1))
    return inputs, simulate(model(), episode_keys(range(runs)), inputs).measurements


def less_input(inputs, measurements):
    return measurements - D * inputs_until(inputs)


def own(name):
    package = FILTERS[name].__module__.split(".")[1]
    return {"inverted": 0} if name == "inversion" else {"ensemble_size": 8} if package in ENSEMBLES else {}


@pytest.mark.parametrize("name", slow_but([name for name in FILTERS if name != "low-pass"], QUICK))
def test_of_every_filter(name):
    inputs, z = data(steps=6)
    first, second = (make_filter(name, model(observe), **own(name)) for observe in (h, g))
    estimates, expected = run(first, None, inputs, z), run(second, None, inputs, less_input(inputs, z))
    np.testing.assert_allclose(estimates.means, expected.means, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(estimates.innovations, expected.innovations, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(estimates.log_likelihoods, expected.log_likelihoods, rtol=1e-7, atol=1e-8)
    session, key = first.session(), filter_keys([0])[0]
    session.start(key, z[0, 0])
    belief, _ = first.update(first.init(tuple(map(int, key))), z[0, 0])
    for u, measured in zip(inputs[0], z[0, 1:], strict=True):
        session.step(u, measured)
        belief, _ = first.update(first.predict(belief, u), measured)
    each_close((session.mean, belief.mean), (estimates.means[0, -1], estimates.means[0, -1]), rtol=1e-12)


def test_the_input_of_the_instant_can_be_given():
    first, second = (make_filter("ekf", model(observe)) for observe in (h, g))
    a, b = (filter_.predict(filter_.init(), [0.4]) for filter_ in (first, second))
    np.testing.assert_allclose(first.update(a, [1.0], u=[0.7])[0].mean, second.update(b, [1.0 - D * 0.7])[0].mean)
    np.testing.assert_allclose(first.update(a, [1.0])[0].mean, second.update(b, [1.0 - D * 0.4])[0].mean)
    refused(r"u of a measurement needs a model with h\(x, u, c\)", second.update, b, [1.0], u=[0.7])
    refused("u must be 1 number", first.update, a, [1.0], u=[0.7, 0.1])
    inputs, z = data(1)
    with pytest.raises(ValueError, match="inputs of a model with h.* must be one fewer than measurements"):
        run(first, inputs=np.append(inputs[0], [[0.0]], axis=0), measurements=z[0])


def test_of_smoothers_bounds_and_other_models():
    inputs, z = data()
    less = less_input(inputs, z)
    for name in ("ekf", "enkf"):
        first, second = (make_filter(name, model(observe), **own(name)) for observe in (h, g))
        a, b = (smooth(filter_, None, inputs, seen) for filter_, seen in ((first, z), (second, less)))
        np.testing.assert_allclose(a.means, b.means, rtol=1e-7, atol=1e-8)
    bounds = [posterior_bound(model(observe), inputs, truths=4) for observe in (h, g)]
    np.testing.assert_allclose(*bounds, rtol=1e-9)
    for change in (
        lambda plain: augmented_model(plain, {"dt": (0.01,)}),
        lambda plain: transformed_model(plain, {"x_1": (-20.0, 20.0)}),
        lambda plain: linearize(plain, [0.1, 0.2], [0.3]),
    ):
        first, second = (make_filter("ekf", change(model(observe))) for observe in (h, g))
        a, b = run(first, None, inputs, z), run(second, None, inputs, less)
        np.testing.assert_allclose(a.means, b.means, rtol=1e-6, atol=1e-7)
    assert linearize(model(), [0.1, 0.2], [0.3]).feedthrough == pytest.approx(D)


def test_the_likelihood_has_the_same_slopes():
    inputs, z = data()
    of_q, of_r = np.array([np.eye(2), np.zeros((2, 2))]), np.array([[[0.0]], [[1.0]]])
    a = likelihood(model(), inputs, z, of_q, of_r)
    b = likelihood(model(g), inputs, less_input(inputs, z), of_q, of_r)
    np.testing.assert_allclose(a.values, b.values, rtol=1e-9)
    np.testing.assert_allclose(a.gradients, b.gradients, rtol=1e-8)


def test_wrappers_live_and_tensors_agree_with_run():
    inputs, z = data(2)
    filter_ = make_filter("ekf", model())
    expected = run(filter_, None, inputs, z)
    env = EstimateState(ModelEnv(model()), filter="ekf")
    copies = EstimateStates(ModelVectorEnv(2, truth=model()), filter="ekf")
    _, info = env.reset(seed=0)
    _, infos = copies.reset(seed=0)
    for k, u in enumerate(inputs[0]):
        np.testing.assert_allclose(info["measurement"], z[0, k], rtol=1e-12)
        _, _, _, _, info = env.step(u)
        *_, infos = copies.step(inputs[:, k])
    each_close((info["estimate"], infos["estimate"]), (expected.means[0, -1], expected.means[:, -1]), rtol=1e-9)
    live = filter_.live(late=10.0)
    live.start(0.0, z[0, 0])
    for k, u in enumerate(inputs[0]):
        live.predict_to(0.1 * (k + 1), u)
        if k != 5:
            live.update(0.1 * (k + 1), None, z[0, k + 1])
    live.update(0.6, None, z[0, 6])  # late, with the input that acted then
    np.testing.assert_allclose(live.mean, expected.means[0, -1], rtol=1e-9)
    for name in ("ekf", "enkf"):
        kept = make_filter(name, model(), **own(name))
        found = filters.torch(kept).run(inputs, z)
        np.testing.assert_allclose(found.means.numpy(), run(kept, None, inputs, z).means, rtol=1e-9)


@pytest.mark.parametrize("name", ["ekf", pytest.param("ukf", marks=pytest.mark.slow), "enkf"])
def test_code_in_c_agrees_with_run(name, tmp_path):
    inputs, z = data(1)
    filter_ = make_filter(name, model(), **own(name))
    found = printed(built(filter_, tmp_path), inputs[0], z[0])
    np.testing.assert_allclose(found[:, :2], run(filter_, None, inputs, z).means[0], rtol=1e-9)


def test_a_program_in_c_reads_a_log_as_estimate_does(tmp_path):
    """With a gap, before which the input of the row after it acts, and a missing sample."""
    present = ~np.isin(np.arange(60), [20, 21])
    table = {name: values[present] for name, values in cycled(60)[0].items()}
    table["v_V"][30] = np.nan
    write_columns(tmp_path / "log.csv", table, EXACT)
    filter_ = make_filter("ekf", cell())
    expected = estimate_with(filter_, read_log(tmp_path / "log.csv", cell()))
    write_project(filter_, tmp_path / "c", "battery", dt=1.0)
    command = ["gcc", *WARNINGS, "battery.c", "main.c", "-lm", "-o", "battery"]
    subprocess.run(command, cwd=tmp_path / "c", check=True)
    with open(tmp_path / "log.csv") as rows:
        program = [tmp_path / "c" / "battery", "i_A", "v_V"]
        printed_rows = subprocess.run(program, stdin=rows, capture_output=True, text=True, check=True).stdout
    header, *lines = (tmp_path / "log.csv").read_text().splitlines()
    counted = [f"{1e6 * float(time)!r},{rest}" for time, rest in (line.split(",", 1) for line in lines)]
    text = "\n".join([header.replace("t_s", "Micros"), *counted, ""])
    of_counter = subprocess.run(program, input=text, capture_output=True, text=True, check=True).stdout
    for row, expected_row in zip(of_counter.splitlines(), printed_rows.splitlines(), strict=True):
        assert row.split(",")[1:] == expected_row.split(",")[1:]
    assert of_counter.splitlines()[-1].startswith("59,")
    means = np.array([line.split(",")[1:5:2] for line in printed_rows.splitlines()[1:]], float)
    np.testing.assert_allclose(means, expected.means, rtol=1e-9, atol=1e-12)


def ocv(s):
    return 3.3 + 0.7 * s + 0.1 * math.tanh(8.0 * (s - 0.1))


class Cell(NamedTuple):
    dt: float = 1.0
    capacity: float = 3000.0  # [A s]
    resistance: float = 0.03  # [ohm]
    time: float = 24.0  # of the overvoltage [s]
    series: float = 0.05  # R_0 [ohm]


def discharge(x, u, c):
    fallen = math.exp(-c.dt / c.time)
    return x[0] - c.dt * u[0] / c.capacity, fallen * x[1] + (1.0 - fallen) * c.resistance * u[0]


def voltage(x, u, c):
    return (ocv(x[0]) - x[1] - c.series * u[0],)


def cell(observe=voltage):
    names = {"states": [("charge", "s"), ("overvoltage", "v_1", "V")], "input_quantities": [("current", "i", "A")]}
    prior = {"prior_mean": [0.5, 0.0], "prior_cov": [0.09, 1e-4], "measurements": [("voltage", "v", "V")]}
    noise = {"process_noise_cov": [1e-10, 1e-8], "measurement_noise_cov": [0.002**2]}
    return StateSpaceModel(transition=discharge, observe=observe, constants=Cell(), **names, **prior, **noise)


def cycled(rows=600, seed=0):
    """A log of a cell, current and voltage sampled in the same rows, and its charge."""
    rng, x, c = np.random.default_rng(seed), (0.9, 0.0), Cell()
    currents = np.repeat(rng.uniform(-1.0, 4.0, rows // 12), 12)
    charges, volts = [], []
    for k, current in enumerate(currents):
        x = discharge(x, (current,), c) if k else x
        charges.append(x[0])
        volts.append(voltage(x, (current,), c)[0] + 0.002 * rng.normal())
    return {"t_s": np.arange(rows) * c.dt, "i_A": currents, "v_V": np.array(volts)}, np.array(charges)


def test_the_charge_of_a_cell_is_found_from_a_log_as_it_is():
    """Within 0.04 % of capacity, where the current of the step before, as a state, has three times the error."""
    table, charges = cycled()
    log = read_log(table, cell())
    assert log.until and (log.inputs[:, 0] == table["i_A"][1:]).all()
    found = estimate_with(make_filter("ekf", cell()), log)
    assert np.sqrt(((found.means[100:, 0] - charges[100:]) ** 2).mean()) < 4e-4
    assert 0.8 < findings(found).mean_nis < 1.25 and np.isnan(found.innovations[0]).all()
    by_clock = estimate_with(make_filter("ekf", cell()), read_log(table, cell(), grid=False))
    np.testing.assert_allclose(by_clock.means, found.means, rtol=1e-9)
    replayed = EstimateState(ReplayEnv(table, cell()), filter="ekf")
    replayed.reset(seed=0)
    for k in range(1, 20):
        *_, info = replayed.step([0.0])
        np.testing.assert_allclose(info["estimate"], found.means[k], rtol=1e-9)


def test_innovations_that_follow_the_input_of_their_row_name_the_cause():
    table, _ = cycled()
    for model_, inputs_act, remedy in (
        (cell(), "from", 'read the log with inputs_act="until"'),
        (cell(lambda x, c: voltage(x, (0.0,), c)), None, r"give h\(x, u, c\)"),
        (cell(), None, None),
    ):
        found = estimate_with(make_filter("ekf", model_), read_log(table, model_, inputs_act=inputs_act))
        words = " ".join(verdict(found, findings(found)))
        assert bool(remedy) == ("follow the input of the same instant" in words)
        assert remedy is None or re.search(remedy, words)


def test_blocks_of_logs_and_steps_of_any_length():
    logs = [read_log(cycled(240, seed)[0], cell(), name=f"cell {seed}") for seed in range(3)]
    data_of_blocks = LogProblem(logs, cell()).data((0, 1))
    assert np.isnan(data_of_blocks.measurements[:, 0]).all()  # the input until then is in none of their rows
    assert not np.isnan(data_of_blocks.measurements[:, 1:10]).any()
    free = Coordinates([Parameter("series", 0.01, 0.2, default=0.05)])
    likelihood = likelihood_of(logs, lambda series: cell().replace(constants=Cell(series=series)), free)
    blocks = likelihood.data_at(free.start()).measurements
    assert np.isnan(blocks[:, 0]).all() and not np.isnan(blocks[:, 1:]).any()
    rows = as_rows(read_log(cycled(60)[0], cell(), grid=False))
    z = rows.measurements[None].copy()
    z[:, 0] = np.nan
    of_steps = run(make_filter("ekf", in_any_steps(cell())), None, rows.inputs[None], z)
    of_one = run(make_filter("ekf", cell()), None, rows.inputs[None, :, :1], z)
    np.testing.assert_allclose(of_steps.means, of_one.means, rtol=1e-9)


def test_logs_are_written_as_they_are_read(tmp_path):
    log = read_log(cycled(48)[0], cell())
    write_log(tmp_path / "log.csv", log)
    again = read_log(tmp_path / "log.csv", cell())
    each_equal((again.inputs, again.measurements), (log.inputs, log.measurements))
    refused("inputs_act must be one of from, until", read_log, tmp_path / "log.csv", cell(), inputs_act="after")


def test_lines_of_matlab_take_the_input_before():
    problem = ModelProblem(model(), inputs=[0.0] * 5, steps=5, first_scored_step=0)
    text = matlab_function(untuned_choice("ekf", problem), model(), "mine", None)
    assert "m.h(x, before)" in text and "measurement(x, u)" in text and "m.h(x)" not in text


def test_an_affine_model_has_a_matrix_d():
    inputs, matrices = np.random.default_rng(1).normal(size=(2, 30, 2)), MATRICES
    affine = affine_model(**matrices, d=[[1.0, -2.0]], **NOISE)
    z = simulate(affine, episode_keys([0, 1]), inputs).measurements
    means = run(make_filter("kf", affine), None, inputs, z).means
    less = z - inputs_until(inputs) @ affine.feedthrough.T
    np.testing.assert_allclose(
        means, run(make_filter("kf", affine_model(**matrices, **NOISE)), None, inputs, less).means
    )
    with pytest.raises(ValueError, match=r"d must have shape \(m, p\) = \(1, 2\), .* but got \(2, 1\)"):
        affine_model(**matrices, d=[[1.0], [2.0]], **NOISE)
