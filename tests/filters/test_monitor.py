"""Alarms: thresholds beside published run lengths, tests beside a naive text, stated rates, a tuned file's."""

import json
import math

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers its envs
from filters import EstimateState
from filters import monitoring as of_monitors
from filters.logs.estimate import estimate_with
from filters.logs.findings import alarms_of, columns_of, episodes
from filters.monitoring import (
    TESTS,
    Alarm,
    Monitor,
    chi_square,
    cusum_run_length,
    cusum_threshold,
    glr_run_length,
    glr_threshold,
    monitor_for,
    monitor_of,
    tuned_monitor,
)
from filters.registry import make_filter
from tests.filters.checks import refused
from tests.tuned_files import rewrite, write_untuned
from thruster_env.core.compiled import interpreted, is_interpreting
from thruster_env.logs.log import Log
from thruster_env.model.quantities import Quantity
from tuning.api.estimate import episode_sentence
from tuning.evaluation.tuned import monitor_data
from tuning.problems.find import find_problem


@pytest.mark.parametrize(
    "threshold, shift, length",  # Montgomery, Introduction to Statistical Quality Control, table 9.3: k = 0.5
    [(4.0, 0.0, 168.0), (5.0, 0.0, 465.0), (4.0, 0.5, 26.6), (5.0, 1.0, 10.4), (4.0, 2.0, 3.34), (5.0, 4.0, 2.01)],
)
def test_run_lengths_of_the_cusum_are_those_of_the_textbook(threshold, shift, length):
    assert cusum_run_length(threshold, 0.5, shift) == pytest.approx(length, rel=5e-3)


@pytest.mark.parametrize(
    "reference, threshold",  # Montgomery, section 9.1.3, after Hawkins (1993): a run length of 370
    [(0.25, 8.01), (0.5, 4.77), (0.75, 3.34), (1.0, 2.52), (1.25, 1.99), (1.5, 1.61)],
)
def test_thresholds_of_the_cusum_are_those_of_the_textbook(reference, threshold):
    assert cusum_threshold(370.0, reference) == pytest.approx(threshold, abs=0.006)


def test_thresholds_have_the_run_lengths_that_are_asked_for():
    assert cusum_run_length(cusum_threshold(4e5, 0.5), 0.5) == pytest.approx(4e5, rel=1e-6)
    assert glr_run_length(glr_threshold(4e5, 50), 50) == pytest.approx(4e5, rel=1e-6)
    assert chi_square(20.0, 1) == pytest.approx(1.959964**2, rel=1e-6)


def drawn(steps, m, seed=0):
    """White innovations with a covariance that has correlations, and measurements."""
    rng = np.random.default_rng(seed)
    root = np.tril(rng.standard_normal((m, m))) + 2.0 * np.eye(m)
    v = rng.standard_normal((steps, m)) @ root.T
    return v, np.broadcast_to(root @ root.T, (steps, m, m)).copy(), rng.standard_normal((steps, m))


@pytest.mark.parametrize("channels", [1, 2])
def test_false_alarms_are_as_rare_as_is_said(channels):
    found = Monitor(steps_between=500.0).alarms(*drawn(1_000_000, channels))
    counts = [sum(one.test == test for one in found) for test in TESTS]
    assert len(found) == pytest.approx(2000, rel=0.1)
    assert counts[:4] == pytest.approx([500] * 4, rel=0.2)  # four deviations of a count are 18 %
    assert counts[4:] == [0, 0]


def naive(v, s, z, monitor):
    """All tests as one would write them for one channel."""
    e, found, seen = v[:, 0] / np.sqrt(s[:, 0, 0]), [], []
    each = 4 * monitor.steps_between
    h, g = cusum_threshold(each, 0.5 * monitor.bias), glr_threshold(each, monitor.window)
    sums, began, since_glr, block = {1: 0.0, -1: 0.0}, {1: 0, -1: 0}, 0, []
    for k in range(len(e)):
        if math.isnan(z[k, 0]):
            if k >= monitor.missing - 1 and np.isnan(z[k - monitor.missing + 1 : k + 1, 0]).all():
                if k == monitor.missing - 1 or not math.isnan(z[k - monitor.missing, 0]):
                    found.append(("missing", k))
            continue
        seen.append(k)
        if e[k] ** 2 >= chi_square(each, 1):
            found.append(("outlier", k))
        for sign in (1, -1):
            began[sign] = k if sums[sign] == 0.0 else began[sign]
            sums[sign] = max(0.0, sums[sign] + sign * e[k] - 0.5 * monitor.bias)
            if sums[sign] >= h:
                found.append(("cusum", k, began[sign]))
                sums[sign] = 0.0
        last = [e[j] for j in seen if j >= since_glr][-monitor.window :]
        ratios = [abs(sum(last[-n:])) / math.sqrt(n) for n in range(1, len(last) + 1)]
        if max(ratios) >= g:
            found.append(("glr", k, np.argmax(ratios) + 1))
            since_glr = k + 1
        block.append(e[k] ** 2)
        if len(block) == monitor.block:
            low, high = monitor.limits(1)[3:5]
            if not low <= sum(block) <= high:
                found.append(("variance", k))
            block = []
        equal = [j for j in seen[-monitor.stuck :] if z[j, 0] == z[k, 0]]
        before = seen[-1 - monitor.stuck] if len(seen) > monitor.stuck else None
        if len(equal) == monitor.stuck and (before is None or z[before, 0] != z[k, 0]):
            found.append(("stuck", k))
    return found


def test_the_tests_are_those_of_a_naive_text():
    v, s, z = drawn(3000, 1, seed=3)
    v[1000:1100] += 2.0
    v[1500:1700] *= 2.5
    z[2000:2030], z[2100:2125], z[2200] = z[2000], np.nan, np.nan
    monitor = Monitor(steps_between=200.0, window=20, block=30)
    found = monitor.alarms(v, s, z)
    expected = naive(v, s, z, monitor)
    assert sorted((one.test, one.step) for one in found) == sorted(one[:2] for one in expected)
    cusums = {one.step: one.since for one in found if one.test == "cusum"}
    assert cusums == {one[1]: one[2] for one in expected if one[0] == "cusum"}
    lengths = {one.step: one.step - one.since + 1 for one in found if one.test == "glr" and one.step < 2000}
    assert lengths == {one[1]: one[2] for one in expected if one[0] == "glr" and one[1] < 2000}
    assert {one.test for one in found} == set(TESTS)


def test_a_bias_is_found_with_its_beginning_its_size_and_its_channel():
    v, s, z = drawn(600, 2, seed=1)
    v[300:, 1] -= 4.0 * np.sqrt(s[0, 1, 1])
    first = [one for one in Monitor().alarms(v, s, z) if one.test in ("glr", "cusum")][0]
    assert first.channel == 1 and abs(first.since - 300) <= 1 and first.step < 305
    assert first.size == pytest.approx(-4.0 * np.sqrt(s[0, 1, 1]), rel=0.5)


def test_noise_that_shrinks_or_grows_is_told_by_its_variance():
    v, s, z = drawn(500, 1)
    v[100:200], v[300:400] = 0.3 * v[100:200], 2.0 * v[300:400]
    found = [one for one in Monitor().alarms(v, s, z) if one.test == "variance"]
    assert found[0].step == 149 and found[0].since == 100 and found[0].size == pytest.approx(0.09, rel=0.5)
    assert {one.step for one in found} <= {149, 199, 349, 399} and found[-1].size == pytest.approx(4.0, rel=0.5)


def test_the_joint_test_of_outliers_counts_the_channels_that_are_there():
    v, s, z = drawn(3, 3)
    v[:] = 0.0
    v[1] = np.linalg.cholesky(s[1]) @ [0.0, 0.0, 7.0]
    z[2, 2] = np.nan
    v[2] = v[1]  # of what is not there nothing is said
    found = Monitor().alarms(v, s, z)
    assert [(one.test, one.step) for one in found if one.test == "outlier"] == [("outlier", 1)]


def test_a_filter_that_is_lost_says_nothing_of_a_sensor():
    v, s, z = drawn(200, 1)
    v[50:60] = np.nan
    assert all(one.test != "outlier" for one in Monitor(steps_between=1e9).alarms(v, s, z))


def test_a_watch_step_by_step_says_the_same():
    v, s, z = drawn(800, 2, seed=5)
    v[400:, 0] += 1.5
    monitor = Monitor(steps_between=1000.0, memory=30)
    watch = monitor.watch(2)
    for _ in range(2):  # a restart forgets everything
        told = [watch.step(*those) for those in zip(v, s, z, strict=True)]
        assert [alarm for one in told for alarm in one.alarms] == monitor.alarms(v, s, z)
        last = None
        for k, one in enumerate(told):
            last = k if one.alarms else last
            assert one.ok == (last is None or k - last >= 30)
        assert watch.latest[0].channel == 0
        watch.restart()


def test_wrappers_tell_of_health_and_keep_their_monitor():
    """Copies tell what one env does: test_vector_wrapper.py."""
    env = EstimateState(gym.make("BowThruster-v0"), "ekf", monitor=200.0)
    assert json.loads(env.spec.to_json())["additional_wrappers"][-1]["kwargs"]["monitor"]["steps_between"] == 200.0
    env.reset(seed=8)
    alarms = [env.step(np.float32([10.0 * math.sin(0.05 * k)]))[-1]["health"].alarms for k in range(300)]
    assert any(alarms)
    env.reset(seed=9)
    assert env.step(np.float32([1.0]))[-1]["health"].ok


@pytest.mark.parametrize(
    "given, rule",
    [
        ({"window": 5}, "window must be a whole number of at least 10, but got 5"),
        ({"horizon": 5}, "an attribute of a monitor must be one of steps_between, .* but got 'horizon'"),
        (10.0, "steps_between must be from 100 to 1e12, but got 10"),
        ({"bias": 0.0}, "bias must be positive"),
    ],
)
def test_monitors_that_cannot_be(given, rule):
    refused(rule, monitor_of, given)


def test_a_filter_without_a_covariance_has_no_innovations_to_test():
    with pytest.raises(ValueError, match="a monitor needs a filter with a covariance, but 'low-pass' has none"):
        EstimateState(gym.make("BowThruster-v0"), "low-pass", monitor=True)
    assert EstimateState(gym.make("BowThruster-v0"), "low-pass").reset(seed=0)


def vehicle_log(spoil):
    """A log of the vehicle with all its instruments, and a filter that knows the truth."""
    problem = find_problem("auv:motion")
    model = problem.model(**problem.true)
    data = problem.data([5])
    z = data.measurements[0].copy()
    spoil(z)
    told = problem.quantities
    log = Log("dive", problem.dt, data.inputs[0], z, model.input_quantities, told.measurements)
    return estimate_with(make_filter("ekf", model), log)


@pytest.mark.slow
def test_the_faulty_channel_is_the_one_without_which_alarms_end():
    def spoil(z):
        z[400:, 5] += 0.02  # r [rad/s], of deviation 0.003

    found = vehicle_log(spoil)
    told = alarms_of(found, Monitor(), 50, isolate=True)
    assert told.at_fault == 5 and told.without[5] == min(told.without)
    assert min(one.step for one in told.alarms) >= 400
    columns = columns_of(found, told)
    assert columns["alarm_r"][400:].sum() > 0 and columns["alarm_r"][:400].sum() == 0
    whole = alarms_of(vehicle_log(lambda z: None), Monitor(), 50, isolate=True)
    assert whole.at_fault is None and len(whole.alarms) <= 2


def test_episodes_are_told_in_words():
    times, thrust = 0.1 * np.arange(100), Quantity("thrust", "T", "N")
    alarms = [Alarm("cusum", 0, 30, 20, 0.5), Alarm("glr", 0, 40, 21, 0.6), Alarm("outlier", 0, 95, 95, -4.0)]
    first, second = episodes(alarms, 50)
    assert episode_sentence(first, thrust, times) == (
        "T: a bias of +0.5 N since 2 s, found at 3 s (cusum); 1 more alarm until 4 s (glr)"
    )
    assert episode_sentence(second, thrust, times) == "T: an outlier -4 N off at 9.5 s (outlier)"
    dead = [Alarm("outlier", 0, 30, 30, 0.5), Alarm("stuck", 0, 38, 29, 10.0), Alarm("glr", 0, 40, 31, 0.6)]
    assert episode_sentence(dead, thrust, times) == (
        "T: equal readings since 2.9 s, found at 3.8 s (stuck); 2 more alarms until 4 s (outlier, glr)"
    )


@pytest.mark.parametrize("dead", ["stuck", "missing"])
@pytest.mark.parametrize("channels", [1, 2])
def test_a_dead_sensor_is_not_healthy_again_until_it_moves(dead, channels):
    v, s, z = drawn(300, channels, seed=4)
    v[:] *= 0.5  # no other test has an alarm
    z[20:220, -1] = z[20, -1] if dead == "stuck" else math.nan
    monitor = Monitor(stuck=6, missing=6, memory=15, block=100_000)
    watch = monitor.watch(channels)
    ok = [watch.step(*one).ok for one in zip(v, s, z, strict=True)]
    assert all(ok[:25]) and not any(ok[25:220]) and all(ok[220:])
    for last in (22, 30, 120, 219, 220, 240):  # and so it is after going back, as a late sample has it
        again = monitor.watch(channels)
        for k in range(last):
            again.step(v[k], s[k], z[k])
        memory = again.memory()
        again.step(v[last], s[last], np.full(channels, 7.0))
        again.recall(memory)
        assert [again.step(v[k], s[k], z[k]).ok for k in range(last, 300)] == ok[last:]


def test_a_monitor_that_ran_as_python_first_is_compiled_afterwards():
    with interpreted():
        Monitor().alarms(np.zeros((3, 1)), np.ones((3, 1, 1)), np.zeros((3, 1)))
        assert of_monitors._compiled(is_interpreting())[1].in_python
    assert not of_monitors._compiled(is_interpreting())[1].in_python


def test_arrays_that_do_not_fit_are_refused():
    """Machine code would read behind them."""
    v, s, z = np.zeros((5, 2)), np.tile(np.eye(2), (5, 1, 1)), np.zeros((5, 2))
    for arguments in ((v[:4], s, z), (v, s[:4], z), (v[:, :1], s, z), (v, s, z[:, :1]), (v[0], s[0], z[0])):
        with pytest.raises(ValueError, match=r"must have the shape \(K, m\), covs \(K, m, m\), but got"):
            Monitor().alarms(*arguments)
    with pytest.raises(ValueError, match="a monitor of 2 channels must get as many innovations"):
        Monitor().watch(2).step(v[0, :1], s[0], z[0])


NAN = math.nan


def test_counts_are_above_twice_the_longest_run_of_healthy_ones():
    coarse = np.array([0.0] * 7 + [1.0] * 3 + [2.0] * 9 + [1.0] * 2)
    slow = np.where(np.arange(21) % 8 == 0, np.arange(21.0), NAN)
    run = np.column_stack([coarse, slow])
    over = np.full((9, 2), NAN)  # the run is over
    found = monitor_for(np.array([np.vstack([run, over])]))
    assert (found.stuck, found.missing) == (2 * 9 + 1, 2 * 7 + 1)
    assert monitor_for(np.random.default_rng(0).normal(size=(2, 50, 1))) == Monitor()
    assert monitor_for(np.full((1, 5, 1), NAN)).missing == 10
    kept = monitor_for(np.array([run]), Monitor(steps_between=500.0, stuck=100))
    assert (kept.steps_between, kept.stuck) == (500.0, 100)


def test_thresholds_are_those_of_the_monitor_by_test():
    told = monitor_data(Monitor(), channels=2)["thresholds"]
    assert math.exp(-0.5 * told["outlier"][1]) == pytest.approx(1.0 / 400_000)  # chi^2 of two degrees of freedom
    assert told["glr"] > told["outlier"][0] ** 0.5 > 4.0 and told["cusum"] > 4.0
    assert told["variance"][0] < 50 < told["variance"][1]
    assert (told["stuck"], told["missing"]) == (10, 10)


def test_the_file_has_it_and_older_ones_do_not(tmp_path):
    path = write_untuned(tmp_path / "tuned.json", "outliers")
    content = json.loads(path.read_text())["monitor"]
    assert tuned_monitor(path) == Monitor(stuck=content["stuck"], missing=content["missing"])
    assert content["thresholds"] == monitor_data(tuned_monitor(path), 1)["thresholds"]
    rewrite(path, lambda content: content["monitor"].update(steps_between=3))
    refused("steps_between must be from 100 to 1e12, but got 3 .in the tuned file", tuned_monitor, path)
    rewrite(path, lambda content: content.update(monitor=[1]))
    refused("the monitor of a tuned file must be a mapping", tuned_monitor, path)
    rewrite(path, lambda content: content.pop("monitor"))
    refused("must have a monitor .tune again, or give the steps., but", tuned_monitor, path)
