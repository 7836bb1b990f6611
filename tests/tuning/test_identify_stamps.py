"""Identification on logs' own stamps: the grid's numbers where stamps lie on it, the plant's where they do not."""

import dataclasses
import json
import pickle

import numpy as np
import pytest
from scipy.linalg import expm

import tuning
from filters import Unknown, augmented_model, make_filter
from filters.engine.batch import run
from filters.logs.estimate import by_the_clock
from filters.sensitivity import likelihood
from tests.filters.checks import refused
from tests.filters.test_live import A, oscillator
from thruster_env.core.streams import filter_keys
from thruster_env.logs.log import Log, in_any_steps, in_steps
from thruster_env.logs.read import read_log
from thruster_env.model.continuous import noise_of_densities
from tuning.evaluation.evaluate import evaluate
from tuning.likelihood.identify import validate
from tuning.likelihood.recorded import likelihood_of
from tuning.logs.problem import family_of
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Coordinates
from tuning.search.space import untuned_choice

DT = 0.1
Q = np.array([[1e-3, 4e-4], [4e-4, 2e-3]])
FREE = ["stiffness", "damping"]
START = {"stiffness": 3.0, "damping": 1.0}


def plant():
    return oscillator(measurement_noise_cov=[1e-4, 4e-4])


def stamps_of(rows, seed, jitter=0.8):
    """Jittered stamps about multiples of DT, with a gap of 1.5 s every 80 rows."""
    lengths = np.random.default_rng(seed).uniform(DT * (1 - jitter), DT * (1 + jitter), size=rows - 1)
    lengths[79::80] = 1.5
    return np.concatenate([[0.0], np.cumsum(lengths)])


def recorded(stamps, seed):
    """The oscillator by matrix exponentials from stamp to stamp, with van Loan's noise."""
    rng, whole, rows = np.random.default_rng(seed), np.zeros((3, 3)), len(stamps)
    whole[:2, :2], whole[1, 2] = A, 1.0
    u = np.repeat(rng.choice([-2.0, 2.0], size=rows // 10 + 1), 10)[:rows]
    x = [np.array([0.5, 0.0])]
    for k, length in enumerate(np.diff(stamps)):
        moves = expm(whole * length)
        root = np.linalg.cholesky(noise_of_densities(np.diag([1e-6, 1e-3]), A, length))
        x.append(moves[:2, :2] @ x[-1] + moves[:2, 2] * u[k] + root @ rng.normal(size=2))
    z = np.array(x) + rng.normal(size=(rows, 2)) * [0.01, 0.02]
    return {"time_s": stamps, "u_1": u, "position": z[:, 0], "rate": z[:, 1]}


def rows_of(model, seed=1, rows=60):
    """A jittered log, of which some samples are missing, and its rows with step ratios."""
    data, rng = recorded(np.append(stamps_of(rows, seed), 9.0), seed), np.random.default_rng(seed)
    data["rate"][rng.random(rows + 1) < 0.3] = np.nan
    log = read_log(data, model, grid=False, dt=DT)
    return log, *(one[None] for one in in_steps(log))


def jumping(x, u, c):
    """A step that cannot be traced: the spring is stiffer on one side."""
    stiffness = c.stiffness if int(x[0] > 0.0) else 2.0 * c.stiffness
    return x[0] + c.substep * x[1], x[1] + c.substep * (u[0] - stiffness * x[0] - c.damping * x[1])


def smooth():
    return plant().at(DT, substeps=3).replace(process_noise_cov=Q)


def switched():
    return smooth().replace(transition=jumping, transition_jacobian=None)


@pytest.mark.parametrize(
    "name, make",
    [
        ("ekf", smooth),
        pytest.param("ekf", switched, marks=pytest.mark.slow),
        *(
            (name, smooth)
            for name in ("ekf-robust", "iekf", "ukf", "ckf", "fading", "vb", "enkf", "etkf", "ensrf")
        ),
    ],
)
def test_rows_with_step_ratios_have_the_numbers_of_live(name, make, request):
    if name != "ekf":  # which is compiled
        request.getfixturevalue("as_python")
    model = make()
    log, u, z = rows_of(model)
    assert len(u[0]) > log.steps and u[0, :, 1].max() <= 1.0 + 1e-6
    assert u[0, :, 1].sum() * DT == pytest.approx(log.times[-1])
    expected = by_the_clock(make_filter(name, model), filter_keys([0])[0], log, None)[0]
    found = run(make_filter(name, in_any_steps(model, DT)), filter_keys([0]), u, z)
    ends = np.isin(np.concatenate([[0.0], np.cumsum(u[0, :, 1]) * DT]).round(9), log.times.round(9))
    assert ends.sum() == log.steps + 1
    for one in ("means", "covs", "innovations", "log_likelihoods"):
        numbers = getattr(found, one)[0][ends]
        np.testing.assert_allclose(numbers, getattr(expected, one)[0], rtol=1e-9, atol=1e-12)
    if name == "ekf":
        q_slopes = np.array([np.diag([1.0, 0.0]), [[0.0, 1.0], [1.0, 0.0]], np.diag([0.0, 1.0])])
        value, slopes = likelihood(in_any_steps(model, DT), u, z, q_slopes, np.zeros((3, 2, 2)))
        assert value[0] == pytest.approx(expected.log_likelihoods.sum(), rel=1e-9)
        for slope, direction in zip(slopes[0], q_slopes, strict=True):
            ends = [model.replace(process_noise_cov=Q + sign * 1e-7 * direction) for sign in (1, -1)]
            estimates = (by_the_clock(make_filter(name, one), filter_keys([0])[0], log, None)[0] for one in ends)
            above, below = (one.log_likelihoods.sum() for one in estimates)
            assert slope == pytest.approx((above - below) / 2e-7, rel=1e-5, abs=1e-3)


def objective_of(data, grid):
    log = read_log(data, plant().at(DT), grid=grid, dt=DT)
    family = family_of([log], FREE, model=plant())
    return likelihood_of(family.data, family.model, Coordinates(family.free))


@pytest.mark.slow
def test_gradients_along_constants_and_the_numbers_of_the_grid():
    even = recorded(DT * np.arange(60), 2)
    own, on_grid = (objective_of(even, grid) for grid in (False, True))
    at = own.coordinates.start(START)
    one, other = own(at), on_grid(at)
    assert own.model_at(at).inputs == 2 and on_grid.model_at(at).inputs == 1
    for name in ("value", "gradient", "information"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-9)
    jittered = objective_of(recorded(stamps_of(60, 2), 2), False)
    steps = 1e-5 * np.eye(len(at))
    slopes = [(jittered.value(at + step) - jittered.value(at - step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(jittered(at).gradient, slopes, rtol=1e-5)


@pytest.mark.slow
def test_a_jittering_clock_does_not_move_what_is_identified():
    """On a grid 0.4 of a step's motion passes for noise of the sensors."""
    logs = [recorded(stamps_of(250, seed), seed) for seed in (3, 4)]
    readings = (tuning.read_logs(logs, model=plant(), dt=DT, grid=grid) for grid in (False, True))
    own, on_grid = (tuning.identify(reading, FREE, starts=1, start=START) for reading in readings)
    truth = {"stiffness": 4.0, "damping": 0.6, "R11": 1e-4, "R22": 4e-4}
    for name, value in truth.items():
        assert abs(own.values[name] - value) < 3.5 * own.standard_errors[name], name
    assert abs(own.values["stiffness"] - 4.0) < 0.03 and own.values["R11"] < 1.3e-4
    assert on_grid.values["R11"] > 5e-4 and on_grid.values["R22"] > 2e-3
    assert own.model.inputs == 1 and own.model.constants.stiffness == own.values["stiffness"]
    errors = [one.validation["identified"].one_step["position"] for one in (own, on_grid)]
    assert errors[0] < 0.02 < 0.05 < errors[1]
    assert not any("cut at gaps" in said for said in own.sentences())
    assert validate(own.found, own.runs) == own.validation


def fixed(x, u, c):
    return x[0] + 0.1 * x[1], x[1]


def fixed_channels(x, c):
    return x


@pytest.mark.parametrize(
    "changes, rule",
    [
        ({"filter": "kf"}, "logs on their own stamps must be identified with the ekf, but got filter kf"),
        (
            {"model": smooth().replace(transition=fixed, observe=fixed_channels, constants=()), "free": "Q11"},
            "a model with a constant dt, but got none",
        ),
        ({"model": smooth(), "dt": 0.2}, "must be the model's 0.1 s, but is 0.2 s"),
        ({"model": None, "preset": "tunnel", "free": "lag_thrust"}, "constants do not follow from dt"),
        ({"model": None, "preset": "tunnel", "free": "clock_offset_thrust"}, "must not move these, but got clock"),
    ],
)
def test_what_needs_a_grid_is_refused(changes, rule):
    data = recorded(stamps_of(30, 5), 5)
    data |= {"V_s": data["u_1"], "thrust": data["rate"]}
    options = {"model": plant(), "dt": DT, "grid": False} | changes
    search = {name: options.pop(name) for name in ("free", "filter") if name in options}
    refused(rule, tuning.identify, tuning.read_logs(data, **options), **{"free": FREE, "progress": False} | search)


def test_logs_are_all_on_grids_or_none():
    model = plant().at(DT)
    recordings = [(recorded(DT * np.arange(30), seed), grid) for seed, grid in ((6, True), (7, False))]
    logs = [read_log(recording, model, grid=grid) for recording, grid in recordings]
    logs = [dataclasses.replace(log, name=name) for log, name in zip(logs, ("even", "own"), strict=True)]
    assert all(isinstance(log, Log) for log in logs)
    with pytest.raises(ValueError, match="logs must all lie on grids or none, but own does not and even does"):
        tuning.identify((plant(), logs), FREE, progress=False)


def test_models_made_of_rates_can_be_sent_to_another_process():
    model, x, u = smooth(), (0.3, 0.1), (1.0,)
    for one in (model, in_any_steps(model, DT), augmented_model(model, {"stiffness": Unknown(std=0.5)})):
        again, more = pickle.loads(pickle.dumps(one)), one.inputs - 1
        given = (*x, 4.0)[: one.n], (*u, 0.5)[: 1 + more]
        assert again.transition(*given, one.constants) == one.transition(*given, one.constants)


def test_a_study_on_stamps_of_a_grid_has_the_numbers_of_the_grid():
    model, logs = smooth(), [recorded(np.arange(200) * DT, seed) for seed in range(3)]
    of_both = (
        [read_log(log, model, dt=DT, name=f"{k}", **how) for k, log in enumerate(logs)]
        for how in ({}, {"grid": False})
    )
    by_grid = [LogProblem(each, model) for each in of_both]
    choice = untuned_choice("ekf", by_grid[0])
    found = [evaluate(choice.filter(one), one.data(one.parts.held_out), None) for one in by_grid]
    assert found[1].log_likelihood == pytest.approx(found[0].log_likelihood, rel=1e-9)
    assert found[1].nis.value == pytest.approx(found[0].nis.value, rel=1e-9)


def test_a_tuned_file_from_own_stamps_is_for_the_model_of_a_step(tmp_path):
    model = smooth().replace(process_noise_cov=[1e-2, 1e-2])
    logs = [read_log(recorded(stamps_of(300, s), s), model, grid=False, dt=DT, name=f"{s}") for s in range(3)]
    problem = pickle.loads(pickle.dumps(LogProblem(logs, model)))
    assert any("on their own stamps" in said for said in problem.remarks)
    study = tuning.tune(problem, filter="ekf", trials=6)
    study.save(tmp_path / "tuned.json")
    content = json.loads((tmp_path / "tuned.json").read_text())
    assert [one[1] for one in content["model"]["inputs"]] == ["u_1"] and content["model"]["digest"] == model.digest
    again = tuning.estimate((model, logs[2]), tmp_path / "tuned.json")
    q = np.diag(content["filter"]["model"]["process_noise_cov"])
    assert np.allclose(again.filter.model.process_noise_cov, q) and np.isfinite(again.log_likelihood)
    assert study.held_out.evaluations["tuned"].log_likelihood > 0.0
    with pytest.raises(ValueError, match="a filter on a log's own stamps must know .*, but 'pf' does not"):
        tuning.tune(problem, filter="pf", trials=2)
