"""Q and R of a column of numbers: closed forms, Durbin and Koopman's Nile, statsmodels, drawn records."""

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

import filters
import tuning
from filters.models import NAMED, Scales, named_model
from tests.filters.checks import refused
from thruster_env.graphs.loops import machine_code_of
from tuning.series.answer import _digits, _matrix, outstanding_period
from tuning.series.column import column_of, seconds_text
from tuning.series.fit import Number, choose
from tuning.series.likelihood import ColumnLikelihood
from tuning.series.recursion import _recursion

# Flow of the Nile at Aswan, 1871 to 1970 [1e8 m^3]: Durbin, Koopman (2012), "Time series analysis by state space
# methods", 2nd ed., where Q is 1469.1 and R 15099 (section 2.10).
NILE = """
1120 1160 963 1210 1160 1160 813 1230 1370 1140 995 935 1110 994 1020 960 1180 799 958 1140 1100 1210 1150
1250 1260 1220 1030 1100 774 840 874 694 940 833 701 916 692 1020 1050 969 831 726 456 824 702 1120 1100 832
764 821 768 845 864 862 698 845 744 796 1040 759 781 865 845 944 984 897 822 1010 771 676 649 846 812 742 801
1040 860 874 848 890 744 749 838 1050 918 986 797 923 975 815 1020 906 901 1170 912 746 919 718 714 740
"""
NUMBERS = {
    "constant": {"drift": 0.3},
    "constant-velocity": {"acceleration": 0.7},
    "constant-acceleration": {"jerk": 0.2},
    "ornstein-uhlenbeck": {"time_constant": 2.0, "std": 1.5},
    "local-trend": {"drift": 0.3, "trend_drift": 0.1},
    "singer": {"time_constant": 3.0, "acceleration_std": 0.4},
    "oscillator": {"frequency": 0.3, "damping": 0.1, "std": 1.5},
}


def simulated(name, rows, dt=0.1, noise=0.2, seed=0, steps=None, **numbers):
    """Numbers drawn from a named model, without its code for Q: by many small steps of the rates."""
    signal, parts = named_model(name).signal(numbers or NUMBERS[name]), 40
    rng = np.random.default_rng(seed)
    x, z = np.zeros(len(signal.output)), np.empty(rows)
    for k, length in enumerate([dt] * rows if steps is None else [*steps, 0.0]):
        z[k] = signal.output @ x + math.sqrt(noise) * rng.normal()
        part = length / parts
        step, root = np.eye(len(x)) + signal.slope * part, np.sqrt(np.diag(signal.densities) * part)
        for _ in range(parts):
            x = step @ x + root * rng.normal(size=len(root))
    return z


@pytest.fixture(scope="module")
def nile():
    return tuning.fit(np.array(NILE.split(), dtype=float), model="constant")


@pytest.fixture(scope="module")
def position():
    return tuning.fit(simulated("constant-velocity", 600) + 40.0, 0.1, model="constant-velocity")


def test_the_nile_has_the_variances_of_durbin_and_koopman(nile):
    """Durbin, Koopman (2012), section 2.10.3: 1469.1 and 15098.5."""
    drift, noise = nile.numbers
    assert drift.value == pytest.approx(1469.1, rel=1e-3) and nile.r == pytest.approx(15098.5, rel=1e-4)
    assert nile.q[0, 0] == pytest.approx(drift.value, rel=1e-12) and noise.unit == ""
    assert drift.low < 1469.1 < drift.high
    assert nile.gain[0] == pytest.approx(0.267, abs=1e-3)  # section 2.11
    assert nile.memory == pytest.approx(-1.0 / math.log(1.0 - nile.gain[0]), rel=1e-9)
    assert not nile.is_wrong and "white" in nile.sentences()[-1]


def test_process_noise_has_the_structure_of_the_physics():
    dt, acceleration, jerk = 0.3, 0.7, 0.2
    q = named_model("constant-velocity").signal({"acceleration": acceleration}).noise(dt)
    expected = acceleration * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    np.testing.assert_allclose(q, expected, rtol=1e-12)
    q = named_model("constant-acceleration").signal({"jerk": jerk}).noise(dt)
    powers = [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    np.testing.assert_allclose(q, jerk * np.array(powers), rtol=1e-12)
    signal = named_model("ornstein-uhlenbeck").signal({"time_constant": 2.0, "std": 1.5})
    decay = math.exp(-dt / 2.0)
    np.testing.assert_allclose(signal.transition(dt), [[decay]], rtol=1e-12)
    np.testing.assert_allclose(signal.noise(dt), [[1.5**2 * (1.0 - decay**2)]], rtol=1e-12)


@pytest.mark.parametrize("damping", [0.01, 0.5, 1.0, 1.7])
def test_an_oscillation_keeps_its_deviation_and_frequency(damping):
    signal = named_model("oscillator").signal({"frequency": 0.3, "damping": damping, "std": 1.5})
    f, q = signal.transition(0.4), signal.noise(0.4)
    np.testing.assert_allclose(f @ (2.25 * np.eye(2)) @ f.T + q, 2.25 * np.eye(2), atol=1e-12)  # Lyapunov
    if damping < 1.0:
        turn = abs(np.angle(np.linalg.eigvals(f)[0])) / 0.4
        assert turn == pytest.approx(2.0 * math.pi * 0.3 * math.sqrt(1.0 - damping**2), rel=1e-9)


def test_a_sum_has_the_parts_side_by_side():
    total = named_model("constant-velocity + oscillator")
    assert [number.name for number in total.free] == ["acceleration", "frequency", "damping", "std"]
    model = total.model({**NUMBERS["constant-velocity"], **NUMBERS["oscillator"]}, 0.2, 0.1)
    f, _, _, c, _ = model.matrices()
    np.testing.assert_array_equal(f[:2, 2:], 0.0)
    np.testing.assert_array_equal(c, [[1.0, 0.0, 1.0, 0.0]])
    both = named_model("ornstein-uhlenbeck + oscillator")
    stds = [number.name for number in both.free if "std" in number.name]
    assert stds == ["ornstein_uhlenbeck_std", "oscillator_std"]
    two_levels = "constant + constant-velocity", "at most one part with a level"
    for name, rule in (("oscillator + oscillator", "parts of a sum must differ"), two_levels):
        refused(rule, named_model, name)


@pytest.mark.parametrize("name", NUMBERS)
def test_intervals_hold_the_numbers_that_made_the_data(name):
    """Fixed seeds, of which the intervals hold all numbers: a wrong power of dt or a factor 2 is far outside."""
    fit = tuning.fit(simulated(name, 800, seed=3), 0.1, model=name)
    for number in fit.numbers:
        value = {**NUMBERS[name], "R": 0.2}[number.name]
        # Wider by half, in logarithms: these are 95 % intervals of 17 numbers.
        low, high = (number.value * (end / number.value) ** 1.5 for end in (number.low, number.high))
        assert low < value < high, (number, value)


def test_an_answer_can_be_copied_and_sent(position):
    sent = pickle.loads(pickle.dumps(position))
    assert str(sent) == str(position) and copy.deepcopy(position).name == position.name
    np.testing.assert_array_equal(sent.filter.model.numbers, position.filter.model.numbers)


def test_white_noise_about_a_level_has_no_drift():
    z = 5.0 + np.random.default_rng(4).normal(size=400)
    fit = tuning.fit(z)
    drift = fit.numbers[0]
    assert fit.name == "constant" and not drift.determined and drift.high < 0.01
    assert fit.r == pytest.approx(np.var(z), rel=0.02) and fit.memory > 20.0
    assert "do not determine drift" in str(fit)


def test_the_unit_of_time_scales_the_numbers_and_moves_no_estimate(position):
    z = position.column.values
    slower = tuning.fit(z, 100.0, model="constant-velocity")  # a thousand times
    assert slower.numbers[0].value == pytest.approx(position.numbers[0].value / 1e9, rel=1e-4)
    assert slower.r == pytest.approx(position.r, rel=1e-4)
    assert slower.memory == pytest.approx(1e3 * position.memory, rel=1e-4)
    scaled = tuning.fit(1e3 * z, 0.1, model="constant-velocity")
    assert scaled.r == pytest.approx(1e6 * position.r, rel=1e-4)
    np.testing.assert_allclose(scaled.gain, position.gain, rtol=1e-4)


def test_the_right_model_is_chosen():
    fit = tuning.fit(simulated("constant-velocity", 600, noise=0.05), 0.1)
    assert fit.name == "constant-velocity" and len(fit.candidates) == 6
    assert tuning.fit(simulated("constant", 600, noise=0.05), 0.1).name == "constant"
    text = str(fit)
    assert text.index("Model: constant-velocity") < text.index("acceleration") < text.index("Steady-state gain")
    assert "local-trend" in text


def test_what_no_model_fits_is_said_before_any_number():
    rng = np.random.default_rng(1)
    z = np.sin(np.arange(800) * 0.9) + 0.01 * rng.normal(size=800)
    fit = tuning.fit(z, 0.1, model="constant")
    assert fit.is_wrong
    text = str(fit)
    assert text.index("No model that was tried fits") < text.index("Model:") < text.index("R =")


def test_noise_is_found_on_a_record_that_goes_far():
    """A position that accelerates leaves its noise far behind: R is a trillionth of the spread's square."""
    z = simulated("constant-acceleration", 2000, noise=0.2, seed=5, jerk=10.0)
    fit = tuning.fit(z, 0.1, model="constant-acceleration")
    assert fit.column.scales.spread**2 > 1e9 and fit.r == pytest.approx(0.2, rel=0.15)


def test_missing_numbers_and_gaps_are_rows_without_a_number(position):
    z = position.column.values.copy()
    times = 0.1 * np.arange(len(z))
    lost = np.random.default_rng(2).uniform(size=len(z)) < 0.1
    lost[0] = False
    z[lost] = np.nan
    by_nan = tuning.fit(z, 0.1, model="constant-velocity")
    by_gap = tuning.fit(z[~lost], times=times[~lost], model="constant-velocity")
    assert by_nan.r == pytest.approx(by_gap.r, rel=1e-9) and by_nan.r == pytest.approx(position.r, rel=0.2)
    assert f"{int(lost.sum())} missing" in str(by_nan)


def test_a_fit_on_unequal_steps_filters_them_anew(as_python):
    steps = np.random.default_rng(4).uniform(0.05, 0.4, 80)
    z = simulated("ornstein-uhlenbeck", 81, steps=steps) + 5.0
    fit = tuning.fit(z, steps, model="ornstein-uhlenbeck")
    table = fit.estimates.to_frame()
    np.testing.assert_allclose(table.index, np.append(0.0, np.cumsum(steps)))
    assert len(fit.estimates.plot().axes) == 2 and str(fit.estimates).startswith("Estimates of kf: 81 rows")
    with pytest.raises(ValueError, match=r"noise=plant.noise, where plant is fit.plant .* dt fit.column.dt"):
        filters.run(fit.filter, z, dt=steps)
    plant = fit.plant
    ekf = filters.make_filter("ekf", plant.at(fit.column.dt))
    anew = filters.run(ekf, z, dt=steps, noise=plant.noise)
    np.testing.assert_allclose(anew.means, fit.estimates.means[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(anew.covs, fit.estimates.covs[0], rtol=1e-6)
    assert filters.run(fit.filter, z).to_frame().index[1] == pytest.approx(fit.column.dt)
    refused("but got SeriesFit.*: use its .filter", filters.run, fit, z)


def test_unequal_steps_are_taken_as_they_are():
    """A position that goes far, on times with jitter: on a grid R would have jitter times velocity in it."""
    times = np.cumsum(np.random.default_rng(6).uniform(0.05, 0.15, 800))
    z = simulated("constant-acceleration", 800, seed=6, steps=np.diff(times), jerk=20.0)
    fit = tuning.fit(z, times=times, model="constant-acceleration")
    assert fit.r == pytest.approx(0.2, rel=0.2) and fit.numbers[0].low < 20.0 < fit.numbers[0].high
    assert not fit.is_wrong and "s apart" in str(fit) and "Q of a step of " in str(fit)
    terms = fit.estimates.log_likelihoods[0, 3:].sum()
    assert terms == pytest.approx(fit.chosen.log_likelihood, abs=0.1)  # after a wide prior, in place of none
    rounded = column_of(z, times=np.round(0.1 * np.arange(800), 3) + 0.0004 * (np.arange(800) % 2))
    assert rounded.stamps is not None and column_of(z, times=np.round(np.arange(800) / 30, 3)).stamps is None


def test_the_filter_is_the_one_of_the_estimates(position):
    belief_path = filters.run(position.filter, None, np.zeros((1, 599, 0)), position.column.values[None, :, None])
    np.testing.assert_array_equal(belief_path.means, position.estimates.means)
    settled = position.estimates
    gain = settled.means[0, -1] - position.model.matrices()[0] @ settled.means[0, -2]
    np.testing.assert_allclose(gain / settled.innovations[0, -1, 0], position.gain, rtol=1e-9)


def test_the_likelihood_is_that_of_the_filters_innovations_and_its_scale_the_best(position):
    likelihood = ColumnLikelihood(named_model(position.name), position.column)
    at = likelihood.coordinates.of([number.value for number in position.numbers])
    terms = position.estimates.log_likelihoods[0, position.model.n :]  # after a wide prior, in place of none
    assert likelihood.value(at) == pytest.approx(terms.sum(), rel=1e-6)
    value, scaled = likelihood.scaled(at + [1.5, 0.7])
    here = likelihood(scaled)
    assert here.value == pytest.approx(value, rel=1e-9) and abs(here.gradient.sum()) < 1e-4


@pytest.mark.parametrize(
    "name", ["constant-acceleration", "singer", "constant + oscillator", "ar:2 + constant", "seasonal:period=4"]
)
def test_the_likelihood_is_that_of_an_exact_diffuse_filter_on_unequal_steps(name):
    """statsmodels' filter, stationary states as their covariance says and the others diffuse."""
    statespace = pytest.importorskip("statsmodels.tsa.statespace.api")
    kalman_filter = pytest.importorskip("statsmodels.tsa.statespace.kalman_filter")
    rng = np.random.default_rng(8)
    steps = np.ones(59) if "ar:" in name or "seasonal" in name else rng.uniform(0.1, 2.0, 59)
    z, times = 3.0 * rng.normal(size=60), np.cumsum(np.append(0.0, steps))
    times[30:] += 9.0
    z[[4, 40]] = np.nan
    column = column_of(z, times=times)
    likelihood = ColumnLikelihood(named_model(name), column)
    names = likelihood.coordinates.names
    values = [-0.3 - 0.2 * i if name.startswith("partial") else 1.5 + 0.2 * i for i, name in enumerate(names)]
    signal = likelihood._signal(values)
    oracle = kalman_filter.KalmanFilter(1, len(signal.output))
    oracle.bind(likelihood._z.copy())
    oracle["design"], oracle["obs_cov"] = signal.output[None], np.array([[values[-1]]])
    oracle["selection"] = np.eye(len(signal.output))
    f, noises = signal.steps(signal.slope, np.append(np.diff(column.times), 1.0), 1.0)
    q = np.tensordot(np.diag(signal.densities)[list(signal.driven)], noises, 1)
    oracle["transition"], oracle["state_cov"] = np.moveaxis(f, 0, 2), np.moveaxis(q, 0, 2)
    first = statespace.Initialization(len(signal.output))
    anywhere = np.isinf(np.diag(signal.first))
    for i in np.flatnonzero(anywhere).tolist():
        first.set(i, "diffuse")
    known = np.flatnonzero(~anywhere)
    if len(known):  # which stand together
        cov = signal.first[np.ix_(known, known)]
        first.set((int(known[0]), int(known[-1]) + 1), "known", stationary_cov=cov)
    oracle.initialize(first)
    result = oracle.filter()
    count = int(anywhere.sum())
    expected = result.llf_obs[result.nobs_diffuse :].sum()
    assert result.nobs_diffuse == count
    assert likelihood.value(likelihood.coordinates.of(values)) == pytest.approx(expected, rel=1e-9)


def test_the_recursion_needs_no_numba():
    code = _recursion  # whose sizes no call knows before
    assert machine_code_of(code._function, code._shapes) is not None


def test_a_record_begins_at_the_mean_of_its_stationary_signal():
    z = simulated("ornstein-uhlenbeck", 60, noise=4.0) + 50.0
    fit = tuning.fit(z, 0.1, model="ornstein-uhlenbeck")
    variance, noise = fit.model.prior_cov[0, 0], fit.r
    expected = (z[0] - fit.level[0]) * variance / (variance + noise)  # the first number counts once
    assert fit.estimates.means[0, 0, 0] == pytest.approx(expected, rel=1e-9)


def test_the_memory_of_a_season_is_that_of_its_harmonics():
    rng = np.random.default_rng(3)
    z = np.cumsum(rng.normal(size=(15, 4)), axis=0).ravel() + 0.1 * rng.normal(size=60)
    fit = tuning.fit(z, model="seasonal:period=4")
    assert 0.5 < fit.memory < 100.0
    a, _, _, c, _ = fit.model.matrices()
    p = fit.model.prior_cov
    for _ in range(400):  # the filter itself; the last quadrature is in no measurement, and its variance grows
        p = a @ p @ a.T + fit.q
        gain = p @ c[0] / (c[0] @ p @ c[0] + fit.r)
        p = p - np.outer(gain, c[0] @ p)
    np.testing.assert_allclose(fit.gain[:3], gain[:3], rtol=1e-6)


def test_the_axes_of_a_track_have_the_same_numbers(position, tmp_path):
    z = position.column.values
    track = np.column_stack([z, simulated("constant-velocity", 600, seed=7) - 90.0])
    track[5:9, 1] = np.nan
    fit = tuning.fit(track, 0.1, model="constant-velocity")
    alone = [tuning.fit(axis, 0.1, model="constant-velocity") for axis in track.T]
    assert min(f.r for f in alone) < fit.r < max(f.r for f in alone)  # of all 1196 numbers
    sizes = [np.log(f.numbers[1].high / f.numbers[1].low) for f in (fit, *alone)]
    assert sizes[0] == pytest.approx(sizes[1] / math.sqrt(2.0), rel=0.1)
    assert fit.gain.shape == (4, 2) and not fit.gain[:2, 1].any()
    np.testing.assert_array_equal(fit.gain[:2, 0], fit.gain[2:, 1])
    assert [state.symbol for state in fit.model.states][2:] == ["position_z_2", "velocity_z_2"]
    assert "double z1, double z2" in fit.code("arduino") and len(fit.plot().axes) == 4
    assert fit.axes_differ() > 1e-3 and not fit.is_wrong
    noisy = track + [[0.0, 2.0]] * np.random.default_rng(3).normal(size=(600, 2))
    assert "The axes differ" in str(tuning.fit(noisy, 0.1, model="constant-velocity"))
    file, rows = tmp_path / "track.csv", enumerate(track.tolist())
    file.write_text("t,x [m],y [m]\n" + "".join(f"{0.1 * k:.1f},{a!r},{b!r}\n" for k, (a, b) in rows))
    assert tuning.fit(file, column="x [m],y [m]", model="constant-velocity").r == pytest.approx(fit.r, rel=1e-9)


def test_a_daily_course_and_steps_between_numbers():
    rng, hours = np.random.default_rng(5), np.arange(240.0)
    z = 12.0 + 4.0 * np.cos(2.0 * np.pi * hours / 24.0) + np.sin(4.0 * np.pi * hours / 24.0)
    z += np.cumsum(0.1 * rng.normal(size=240)) + 0.3 * rng.normal(size=240)
    fit = tuning.fit(z, model="constant + harmonic:period=24,harmonics=2")
    assert fit.r == pytest.approx(0.09, rel=0.35) and not fit.is_wrong
    assert {number.name for number in fit.numbers} == {"constant_drift", "harmonic_drift", "R"}
    values = {"constant_drift": 0.01, "harmonic_drift": 0.02, "R": 0.09}  # the quadrature of period 2 is unseen
    name = "constant + harmonic:period=8,harmonics=4"
    assert 2.0 < replace(fit, chosen=fit.chosen._replace(name=name, values=values)).memory < 8.0
    far = column_of(np.append(z, z), times=np.append(hours, hours + 1e6))  # a gap is a long step
    assert len(far.values) == 480 and far.dt == 1.0
    steps = np.ones(239)
    steps[100] = 3.0
    column = column_of(z, steps)
    assert len(column.values) == 242 and np.isnan(column.values[101:103]).all()
    lost = z.copy()
    lost[[3, 9]] = lost[40:60] = lost[100:130] = np.nan
    missing = "52 of 240 rows are missing, in 4 places, the longest of 30 rows (30 s)."
    assert column_of(lost).remarks == (missing,)
    masked = column_of(np.ma.masked_array(z, mask=hours == 7.0))
    assert np.flatnonzero(np.isnan(masked.values)).tolist() == [7]
    assert masked.remarks == ("1 of 240 row is missing, in 1 place.",)  # without an input that is held


def test_what_a_chosen_model_misses_is_tried_too():
    rng, z = np.random.default_rng(6), np.zeros(400)
    for k in range(2, 400):
        z[k] = 0.6 * z[k - 1] - 0.7 * z[k - 2] + rng.normal()

    def further(chosen, level):
        return ["ar:2"] * (chosen.name == "constant")

    choice = choose(column_of(z), ("constant",), further=further)
    assert choice.chosen.name == "ar:2" and len(choice.candidates) == 2


def test_a_day_that_no_model_has_is_named_with_the_model_that_has_it():
    rng, hours = np.random.default_rng(3), np.arange(240.0)
    z = np.cos(2.0 * np.pi * (hours - 9.0) / 24.0) + 0.4 * np.cos(4.0 * np.pi * hours / 24.0)
    z = 4.0 * z + np.cumsum(0.1 * rng.normal(size=240)) + 0.2 * rng.normal(size=240)
    z[100:107] = np.nan
    fit = tuning.fit(z, 3600.0, model="constant")
    model = "constant + harmonic:period=86400,harmonics=2"
    assert fit.is_wrong and "one each 3600 s (1 h)" in str(fit)
    assert fit.sentences()[1] == f'A period of 86400 s (24 h) stands out: try --model "{model}".'
    assert f'try --model "{model}".' in str(fit).splitlines()[3]
    assert fit.missing_models() == [model, "ar:2", "ar:3", "ar:4"]
    better = tuning.fit(z, 3600.0, model=model)
    assert not better.is_wrong and "harmonics=2,constant_drift=" in str(better).splitlines()[-1]
    week = np.tile([3.0, -1.0, 0.5, 2.0, -2.0, 0.0, 1.0], 40) + 0.2 * np.random.default_rng(5).normal(size=280)
    assert tuning.fit(week, model="constant").missing_models()[0] == "constant + seasonal:period=7,seasons=7"
    for noise in (rng.normal(size=500), np.cumsum(rng.normal(size=500))):
        assert outstanding_period(column_of(noise)) is None
    period = outstanding_period(column_of(np.cos(2.0 * np.pi * np.arange(500) / 23.7) + rng.normal(size=500)))
    assert period.seconds == pytest.approx(23.7, rel=5e-3) and period.harmonics == 1


def test_narrow_intervals_have_digits_and_long_times_words():
    narrow = Number("period", "period", 86397.123, 86390.2, 86404.4, "s", True)
    assert _digits(narrow) == ("86397.12", "86390.2", "86404.4")
    assert _digits(narrow._replace(low=4e4, high=2e5))[:2] == ("8.64e+04", "4e+04")
    lengths = 0.6428, 119.0, 150.0, 6647.8, 86400.0, 2156400.0, 1e9, math.inf
    expected = ["0.643 s", "119 s", "150 s (2.5 min)", "6648 s (1.85 h)", "86400 s (24 h)", "2156400 s (25 days)"]
    assert [*map(seconds_text, lengths)] == [*expected, "1000000000 s (31.7 years)", "inf s"]


def test_a_season_an_autoregression_and_a_period_are_found():
    rng = np.random.default_rng(11)
    pattern = np.tile([3.0, 1.0, -2.0, 0.0, 4.0, -6.0], 50)
    z = pattern + np.cumsum(0.2 * rng.normal(size=300)) + 0.5 * rng.normal(size=300)
    fit = tuning.fit(z, model="constant + seasonal:period=6")
    drift, shape, noise = fit.numbers
    assert drift.low < 0.04 < drift.high and noise.low < 0.25 < noise.high and shape.high < 1e-2
    assert not fit.is_wrong and tuning.fit(z, model="constant").is_wrong
    z = np.zeros(600)
    for k in range(2, 600):  # partial autocorrelations of 1.2/1.6 and -0.6
        z[k] = 1.2 * z[k - 1] - 0.6 * z[k - 2] + rng.normal()
    fit = tuning.fit(z + 7.0, model="ar:2")
    lows, highs = np.array([(number.low, number.high) for number in fit.numbers[:2]]).T
    assert (lows < [0.75, -0.6]).all() and (highs > [0.75, -0.6]).all()
    assert fit.level == pytest.approx([7.0], abs=0.3)
    z = 2.0 * np.cos(2.0 * np.pi * np.arange(400) / 23.7) + rng.normal(size=400)
    period = tuning.fit(z, model="harmonic").numbers[1]
    assert period.low < 23.7 < period.high and period.high - period.low < 0.5
    noise = tuning.fit(rng.normal(size=400), model="oscillator")
    assert "do not determine frequency" in str(noise) and "do not determine damping" in str(noise)


def test_every_start_lies_in_its_range():
    sizes = (1e-6, 1e-7, 1e-3, 10.0, (80.0, 90.0)), (5e4, 1e2, 3600.0, 1e8, (1e-4,)), (1.0, 0.5, 1.0, 30.0, (0.5,))
    for scales in (Scales(*size) for size in sizes):
        for number in (number for model in NAMED.values() for number in model.free):
            low, high = number.range(scales)
            assert 0.0 < low < high < math.inf and all(low <= value <= high for value in number.values(scales))


def test_each_number_has_six_digits():
    text = _matrix(np.array([[0.000151234567, 2.0], [1e-9 / 3.0, 12.3456789]]), "")
    assert text == "[[0.000151235, 2],\n [3.33333e-10, 12.3457]]"
