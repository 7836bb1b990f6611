"""Angles in logs, scales and figures: across the cut at pi nothing is an average of both ends."""

import math

import numpy as np
import pytest

from filters import affine_model, make_filter, run
from filters.logs.estimate import estimate
from filters.logs.findings import draw_log
from thruster_env.core.angles import on_one_branch, with_breaks, wrapped
from thruster_env.core.files import MOST_POINTS, thinned
from thruster_env.core.streams import filter_keys
from thruster_env.logs.grid import Series, mean_held, sampled
from thruster_env.logs.log import Log, at_offset
from thruster_env.logs.read import read_log
from tuning.likelihood.identify import validation_of
from tuning.problems.data import Data
from tuning.problems.log_problem import LogProblem
from tuning.problems.model_problem import ModelProblem
from tuning.reporting.time_figures import draw_estimates, draw_signal

DT, COUNT = 0.1, 401


def model(angle=True, heading=0.0, **changes):
    """A heading that turns at a rate of its own, and a compass."""
    arguments = {
        "a": [[1.0, DT], [0.0, 1.0]],
        "b": [[0.0], [0.0]],
        "c": [[1.0, 0.0]],
        "process_noise_cov": [1e-6, 1e-6],
        "measurement_noise_cov": [1e-4],
        "prior_mean": [heading, 0.2],
        "prior_cov": [0.01, 0.01],
        "states": [("heading", "psi", "rad", angle), ("rate", "r", "rad/s")],
        "input_quantities": [("rudder", "d", "rad", angle)],
        "measurements": [("compass", "z", "rad", angle)],
    }
    return affine_model(**{**arguments, **changes})


def recorded(heading, angle=True):
    """A log about a heading, that sways by 0.4 rad, with its truth; only the heading differs."""
    rng = np.random.default_rng(2)
    times = DT * np.arange(COUNT)
    psi, rate = heading + 0.4 * np.sin(0.5 * times), 0.2 * np.cos(0.5 * times)
    z = psi + rng.normal(scale=0.01, size=COUNT)
    wrap = wrapped if angle else np.array
    one = model(angle)
    states = {"state:psi": wrap(psi), "state:r": rate}
    referred = {"state:psi": one.states[0], "state:r": one.states[1]}
    inputs = np.full((COUNT - 1, 1), wrapped(heading))
    return Log("run", DT, inputs, wrap(z)[:, None], one.input_quantities, one.measurements, states, referred)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("heading", [math.pi, -3.0])
def test_a_clock_offset_goes_the_short_way_round(heading):
    far, cut = recorded(0.0), recorded(heading)
    for channel, part in (("measurement:z", "measurements"), ("state:psi", "references"), ("input:d", "inputs")):
        one, other = (at_offset(log, channel, 0.03) for log in (far, cut))
        if part == "references":
            pair = one.references[channel], other.references[channel]
        else:
            pair = getattr(one, part)[:, 0], getattr(other, part)[:, 0]
        np.testing.assert_allclose(wrapped(pair[1] - pair[0] - heading), 0.0, atol=1e-12)
    moved, nis = at_offset(cut, "measurement:z", 0.03), []
    for log, start in ((at_offset(far, "measurement:z", 0.03), 0.0), (moved, heading)):
        found = run(
            make_filter("kf", model(heading=start)), filter_keys([0]), log.inputs[None], log.measurements[None]
        )
        nis.append((found.innovations[0, :, 0] ** 2 / found.innovation_covs[0, :, 0, 0]).mean())
    assert nis[1] == pytest.approx(nis[0], rel=1e-6)


def test_a_file_with_a_clock_offset_is_read_the_same_way(tmp_path):
    psi = 3.0 + 0.05 * np.arange(8)
    path = tmp_path / "run.csv"
    rows = [f"{DT * k:g},0,{wrapped(v):.17g}" for k, v in enumerate(psi)]
    path.write_text("\n".join(["t,d,z", *rows]), encoding="utf-8")
    found = read_log(path, model(), clock_offset={"z": 0.05}).measurements[:-1, 0]
    np.testing.assert_allclose(wrapped(found - psi[:-1] - 0.025), 0.0, atol=1e-12)


def test_samples_and_inputs_between_two_ends_are_at_the_cut():
    series = Series(np.array([0.05, 0.15, 0.25]), np.array([3.0, -3.0, 3.1]))
    gap = 2 * math.pi - 6.0
    found = sampled(series, 0.1, 4, 0.01, True)
    np.testing.assert_allclose(wrapped(found[1] - 3.0), 0.6 * gap, atol=1e-12)
    assert abs(sampled(series, 0.1, 4, 0.01)[1]) < 1.0  # of plain numbers it is their average
    mean = mean_held(series, 0.1, 3, 0.0, True)
    np.testing.assert_allclose(wrapped(mean[1] - 3.0), 0.5 * gap, atol=1e-12)
    np.testing.assert_allclose(mean_held(series, 0.1, 3)[1], 0.0, atol=1e-12)
    whole = Series(np.array([0.0, 0.1, 0.2]), np.array([3.0, -3.0, 3.1]))
    np.testing.assert_array_equal(mean_held(whole, 0.1, 3, 0.0, True), whole.values)


def test_a_scale_and_a_rule_of_thumb_are_those_of_the_same_swaying_elsewhere():
    far, cut = (LogProblem(recorded(heading), model(heading=heading), lead=20) for heading in (0.0, math.pi))
    np.testing.assert_allclose(cut.scale, far.scale, rtol=1e-3)
    np.testing.assert_allclose(cut.untuned["process_noise_cov"], far.untuned["process_noise_cov"], rtol=1e-3)
    assert far.scale[0] < 0.4


def test_on_one_branch_far_from_the_cut_nothing_changes_and_missing_ones_do_not_count():
    rows = np.random.default_rng(0).normal(scale=0.5, size=(50, 2))
    np.testing.assert_array_equal(on_one_branch(rows, (True, False)), rows)
    assert on_one_branch(rows, ()) is rows
    turned = wrapped(rows + math.pi)
    turned[3, 0] = np.nan
    found = on_one_branch(turned, (True, False))
    assert np.nanstd(found[:, 0]) == pytest.approx(np.delete(rows[:, 0], 3).std(), rel=1e-12)
    assert np.isnan(found[3, 0]) and np.nanstd(turned[:, 0]) > 2.0


@pytest.mark.usefixtures("as_python")
def test_the_fit_of_a_simulation_has_the_spread_of_an_angle():
    fits = []
    for heading in (0.0, math.pi):
        log, one = recorded(heading), model(heading=heading)
        data = Data((0,), log.inputs[None], log.measurements[None], filter_keys([0]), 0)
        fits.append(validation_of(one, data).fit["z"])
    assert fits[1] == pytest.approx(fits[0], abs=0.1)


def upright(axis):
    """The longest step of a line of an axis, up or down."""
    steps = [np.abs(np.diff(line.get_ydata().astype(float))) for line in axis.lines]
    return max(np.nanmax(step) for step in steps if len(step) > 1 and np.isfinite(step).any())


@pytest.mark.slow
@pytest.mark.usefixtures("as_python")
def test_no_figure_has_a_line_from_one_end_to_the_other():
    log, one = recorded(math.pi), model(heading=math.pi)
    figures = [draw_log(estimate(log, "kf", one), "a log")]
    turned = Log(
        "turns",
        DT,
        log.inputs,
        log.measurements,
        one.input_quantities,
        one.measurements,
        {**log.references, "state:psi": log.references["state:psi"] + 6.0 * math.pi},
        log.referred,
    )
    figures.append(draw_log(estimate(turned, "kf", one), "a log whose truth has turns"))
    problem = ModelProblem(one, steps=60, inputs=[[0.0]] * 60, first_scored_step=50)
    data = problem.data([3])
    figures += [draw_signal(make_filter("kf", one), data, 0, DT)]
    figures += [draw_estimates({"kf": make_filter("kf", one)}, data, 0, DT)]
    for figure in figures:
        for axis in figure.axes:
            assert not axis.lines or upright(axis) < math.pi, axis.get_ylabel()


def test_lines_break_at_the_cut_also_where_they_are_thinned():
    x, y = np.arange(4.0), np.array([3.0, -3.0, -2.9, 3.1])
    times, line, band = with_breaks(x, y, y + 1.0)
    np.testing.assert_array_equal(line, [3.0, np.nan, -3.0, -2.9, np.nan, 3.1])
    np.testing.assert_array_equal(np.isnan(band), np.isnan(line))
    np.testing.assert_array_equal(times, [0.0, 1.0, 1.0, 2.0, 3.0, 3.0])
    long = np.arange(4.0 * MOST_POINTS)
    values = np.where(long < 1000.0, 3.0, -3.0)
    _, line = thinned(*with_breaks(long, values))
    assert np.isnan(line).sum() == 1
