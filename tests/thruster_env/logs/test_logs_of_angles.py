"""Angles in logs, scales and figures: across the cut at pi nothing is an average of both ends."""

import math

import numpy as np
import pytest

from filters import affine_model, make_filter, run
from thruster_env.core.angles import on_one_branch, wrapped
from thruster_env.core.streams import filter_keys
from thruster_env.logs.grid import Series, mean_held, sampled
from thruster_env.logs.log import Log, at_offset
from tuning.problems.log_problem import LogProblem

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
