"""A filter over a log: what innovations tell, references, smoothers, files, and logs on their own stamps."""

import dataclasses
import inspect
import math
import pickle

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from filters import make_filter, run, smooth
from filters.logs.estimate import by_the_clock, estimate
from filters.logs.findings import alarms_of, columns_of, compared, draw_log, findings
from filters.monitoring import Monitor
from tests.filters.checks import refused
from tests.filters.test_live import oscillator
from tests.oracles import each_close, each_equal
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.core.streams import filter_keys
from thruster_env.env.model_env import ReplayEnv
from thruster_env.logs.grid import Series
from thruster_env.logs.log import Log, in_steps
from thruster_env.logs.read import at_own_stamps, read_log
from thruster_env.model.continuous import in_discrete_time
from thruster_env.model.quantities import Quantity
from thruster_env.model.simulate import simulate
from thruster_env.thruster.model import logged_model, thruster_model
from tuning.likelihood.parametric import ModelFamily
from tuning.problems.log_problem import LogProblem

POWER = Quantity("power", "P", "W")


def power(x, c):
    return 3.0 * x[0] * x[0]


SEEN = MODEL.replace(outputs={"P": (POWER, power)})
STEPS = 400


@pytest.fixture(scope="module")
def log():
    inputs = np.sin(0.1 * np.arange(STEPS))[None, :, None]
    truth = simulate(MODEL, np.array([[3, 8]]), inputs)
    measured = truth.measurements[0].copy()
    measured[[5, 90, 300]] = np.nan
    states = truth.states[0, :, 0]
    references = {"state:n": states, "output:P": 3.0 * states**2, "output:other": states}
    referred = {"state:n": MODEL.states[0], "output:P": POWER, "output:other": POWER}
    return Log("run", 0.1, inputs[0], measured, MODEL.input_quantities, MODEL.measurements, references, referred)


def test_an_estimate_is_what_the_filter_gives_of_a_batch(log):
    found = estimate(log, "kf", SEEN)
    batch = run(make_filter("kf", SEEN), filter_keys([0]), log.inputs[None], log.measurements[None])
    np.testing.assert_allclose(found.means, batch.means[0], rtol=1e-12)
    np.testing.assert_allclose(found.log_likelihoods, batch.log_likelihoods[0], rtol=1e-9)
    assert (
        np.isnan(found.innovations[[5, 90, 300]]).all()
        and np.isfinite(np.delete(found.innovations, [5, 90, 300])).all()
    )


def test_the_findings_are_those_of_the_rows_that_count(log):
    found = estimate(log, "kf", SEEN)
    told = findings(found, skip=10)
    late, there = slice(10, None), ~np.isnan(log.measurements[10:, 0])
    v, s = found.innovations[late, 0][there], found.innovation_covs[late, 0, 0][there]
    assert told.rows == there.sum() == 389
    assert told.mean_nis == pytest.approx((v**2 / s).mean(), rel=1e-12)
    assert told.nis_band == pytest.approx(chi2.ppf([0.025, 0.975], 389) / 389, rel=1e-9)
    assert told.nis_band[0] < told.mean_nis < told.nis_band[1] and told.whiteness.p_value > 0.05
    expected = sum(multivariate_normal.logpdf(*pair) for pair in zip(v, np.zeros_like(v), s, strict=True))
    assert told.log_likelihood == pytest.approx(expected, rel=1e-9)
    (ahead,) = told.predictions
    assert ahead.rmse == pytest.approx(np.sqrt((v**2).mean())) and ahead.bias == pytest.approx(-v.mean())
    assert list(compared(found)) == ["state:n", "output:P"]  # the model knows of no other
    state, of_power = told.references
    errors = found.means[late, 0] - log.references["state:n"][late]
    assert (state.rmse, state.bias) == pytest.approx((np.sqrt((errors**2).mean()), errors.mean()))
    assert of_power.quantity == POWER and of_power.rows == 391


def test_an_output_has_the_deviation_of_its_linearisation(log):
    found = estimate(log, "kf", SEEN)
    values, std = found.output("P")
    np.testing.assert_allclose(values, 3.0 * found.means[:, 0] ** 2)
    np.testing.assert_allclose(std, 6.0 * abs(found.means[:, 0]) * found.stds[:, 0], rtol=1e-5, atol=1e-9)


def test_a_wrong_noise_shows_in_the_innovations(log):
    sure = findings(estimate(log, "kf", SEEN, model_arguments={"process_noise_cov": [1e-3]}))
    assert sure.mean_nis > sure.nis_band[1] and sure.whiteness.p_value < 1e-3
    unsure = findings(estimate(log, "kf", SEEN, model_arguments={"measurement_noise_cov": [1.0]}))
    assert unsure.mean_nis < unsure.nis_band[0]


def test_a_smoother_is_closer_to_the_truth(log):
    found = estimate(log, "kf", SEEN, smoother=True)
    data = filter_keys([0]), log.inputs[None], log.measurements[None]
    np.testing.assert_array_equal(found.means, smooth(make_filter("kf", SEEN), *data).means[0])
    told = findings(found).references[0]
    assert told.rmse < 0.95 * findings(estimate(log, "kf", SEEN)).references[0].rmse
    lagged = estimate(log, "kf", SEEN, lag=3)  # which asks for a smoother, too
    assert lagged.smoothed
    np.testing.assert_array_equal(lagged.means, smooth(make_filter("kf", SEEN), *data, 3).means[0])


def test_a_filter_without_a_covariance_has_errors_alone(log):
    told = findings(estimate(log, "open-loop", SEEN))
    assert np.isnan(told.mean_nis) and np.isnan(told.log_likelihood) and told.whiteness is None
    assert told.references[0].rmse > 0


def test_columns_hold_all_of_it(log):
    found = estimate(log, "kf", SEEN)
    columns = columns_of(found)
    assert list(columns)[:4] == ["time_s", "input_V_s_V", "measured_tach_rad_per_s", "reference_n_rad_per_s"]
    each_equal((columns["n_rad_per_s"], columns["std_n_rad_per_s"]), (found.means[:, 0], found.stds[:, 0]))
    np.testing.assert_array_equal(columns["innovation_tach_rad_per_s"], found.innovations[:, 0])
    assert {"P_W", "std_P_W", "reference_P_W", "innovation_std_tach_rad_per_s"} <= set(columns)


def test_what_is_measured_stands_behind_the_state_or_output_that_it_measures(log):
    drawn = [
        [dots.get_offsets()[:, 1] for dots in axis.collections if dots.get_label() == "measurement"]
        for axis in draw_log(estimate(log, "kf", SEEN), "kf on run").axes
    ]
    (speed,), *others = drawn  # h(x) = n
    np.testing.assert_array_equal(speed.filled(np.nan), log.measurements[:, 0])
    assert others == [[], []]  # the output P and the innovation


def test_an_estimate_at_which_h_has_no_value_is_drawn_all_the_same(log):
    def root(x, c):
        return (math.sqrt(x[0]),)

    own = make_filter("ekf", SEEN.replace(prior_mean=[1.0], observe=root, observe_jacobian=None))
    axes = draw_log(estimate(log, "kf", SEEN)._replace(filter=own), "ekf").axes
    assert not any(dots.get_label() == "measurement" for axis in axes for dots in axis.collections)


def table(stamps, seed=0, missing=()):
    rng = np.random.default_rng(seed)
    thrust = 5.0 * np.sin(stamps) + rng.normal(size=len(stamps))
    thrust[list(missing)] = np.nan
    return {"time_s": stamps, "V_s": 8.0 * np.sign(np.sin(3.0 * stamps)) + 0.1, "thrust": thrust}


@pytest.mark.parametrize("name", ["ekf", "kf", "enkf", "sage-husa", "pf"])
def test_where_stamps_lie_on_the_grid_the_numbers_are_those_of_the_grid(name):
    stamps = 100.0 + 0.01 * np.delete(np.arange(200), [50, 51, 120])  # rows that are missing
    data = table(stamps, missing=[20, 21, 22])
    smoother = {"ekf": {"lag": 300}, "kf": {"smoother": True}}.get(name, {})
    on_grid = estimate(data, name, thruster_model, **smoother)
    own = estimate(data, name, thruster_model, grid=False, **smoother)
    rows = np.round((stamps - 100.0) / 0.01).astype(int)
    assert own.log.steps + 1 == len(stamps) < on_grid.log.steps + 1 == 200
    np.testing.assert_allclose(own.log.times, stamps - 100.0, atol=1e-12)
    for one in ("means", "covs", "innovations", "innovation_covs", "log_likelihoods"):
        np.testing.assert_allclose(getattr(own, one), getattr(on_grid, one)[rows], rtol=1e-10, atol=1e-10)


def test_sensors_at_rates_of_their_own_are_rows_at_their_own_times():
    rng = np.random.default_rng(3)
    stamps = np.cumsum(rng.uniform(0.01, 0.09, size=80))
    first = rng.random(80) < 0.5
    data = {"time_s": stamps, "u_1": rng.normal(size=80), "position": np.where(first, rng.normal(size=80), np.nan)}
    data["rate"] = np.where(first, np.nan, rng.normal(size=80))
    plant = oscillator()
    found = estimate(data, "ekf", plant, grid=False, dt=0.05)
    live = make_filter("ekf", plant.at(0.05)).live(noise=plant.noise)
    z = np.column_stack([data["position"], data["rate"]])
    live.start(stamps[0], z[0])
    for k in range(1, 80):
        live.predict_to(stamps[k], data["u_1"][k - 1])
        live.update(stamps[k], "position" if first[k] else "rate", z[k][~np.isnan(z[k])])
        each_close((found.means[k], found.covs[k]), (live.mean, live.cov), rtol=1e-10, atol=1e-12)


def test_another_q_than_that_of_the_rates_goes_with_the_length_of_a_step():
    stamps = np.array([0.0, 0.02, 0.05, 0.06, 0.1])
    data = {"time_s": stamps, "u_1": np.ones(5), "position": stamps + 1.0, "rate": stamps**2}
    q = [1e-3, 2e-3]
    found = estimate(data, "ekf", oscillator(), grid=False, dt=0.05, model_arguments={"process_noise_cov": q})
    live = make_filter("ekf", oscillator().at(0.05).replace(process_noise_cov=q)).live()
    live.start(0.0, [1.0, 0.0])
    for k in range(1, 5):
        live.predict_to(stamps[k], [1.0])
        live.update(stamps[k], None, [stamps[k] + 1.0, stamps[k] ** 2])
    np.testing.assert_allclose(found.means[-1], live.mean, rtol=1e-12)


def test_a_clock_offset_moves_stamps_and_inputs_are_held_from_their_own():
    stamps = 0.1 * np.arange(8.0)
    data = {"time_s": stamps, "u_1": np.arange(8.0), "position": stamps, "rate": stamps**2}
    log = read_log(data, oscillator().at(0.1), clock_offset={"rate": 0.03}, grid=False)
    np.testing.assert_allclose(log.times, np.sort([*stamps, *(stamps[1:] - 0.03)]), atol=1e-12)
    np.testing.assert_array_equal(log.inputs[:6, 0], [0, 0, 1, 1, 2, 2])
    rate = log.measurements[~np.isnan(log.measurements[:, 1])]
    np.testing.assert_allclose(rate[:, 1], stamps[1:] ** 2)  # its first sample was before the log's
    assert np.isnan(rate[:, 0]).all()


def damped(damping=0.6):
    """A function that makes a model in continuous time, as users offer one."""
    plant = oscillator()
    return dataclasses.replace(plant, constants=plant.constants._replace(damping=damping))


def test_a_function_may_make_a_model_in_continuous_time():
    rng = np.random.default_rng(7)
    stamps = 0.05 * np.arange(40.0)
    data = {"time_s": stamps, "u_1": rng.normal(size=40), "position": rng.normal(size=40), "rate": stamps}
    of_model, of_function = (estimate(data, "ekf", one, grid=False) for one in (oscillator(), damped))
    np.testing.assert_array_equal(of_function.means, of_model.means)
    assert of_function.noise is not None
    on_grid = estimate(data, "ekf", damped, model_arguments={"damping": 0.6})
    np.testing.assert_allclose(on_grid.means, of_model.means, rtol=1e-9, atol=1e-12)
    made = pickle.loads(pickle.dumps(in_discrete_time(damped)))
    assert list(inspect.signature(made).parameters) == ["damping", "dt"]
    family = ModelFamily(made, ["damping"], dt=0.05)
    assert family.model(damping=0.7).constants.damping == 0.7 and {"damping", "Q11"} <= set(family.known)
    assert in_discrete_time(thruster_model) is thruster_model


@pytest.mark.slow
def test_alarms_and_isolation_work_on_own_stamps():
    rng = np.random.default_rng(5)
    stamps = np.cumsum(rng.uniform(0.01, 0.09, size=300))
    data = {"time_s": stamps, "u_1": np.zeros(300), "position": 0.1 * rng.normal(size=300)}
    data["rate"] = np.where(np.arange(300) < 200, 0.3 * rng.normal(size=300), 0.25)
    found = estimate(data, "ekf", oscillator(), grid=False, dt=0.05)
    told = alarms_of(found, Monitor(stuck=10), isolate=True)
    assert any(one.test == "stuck" and one.step in (208, 209) for one in told.alarms)


@pytest.mark.parametrize(
    "call, rule",
    [
        (
            lambda data: estimate(data, "kf-steady", thruster_model, grid=False),
            "'kf-steady' has the A and B of one dt",
        ),
        (
            lambda data: estimate(data, "ekf", logged_model(lag={"thrust": 0.02}), grid=False),
            "a model whose other constants do not follow from dt",
        ),
        (lambda data: ReplayEnv(data, thruster_model, grid=False).reset(), "must lie on a grid to be replayed"),
        (
            lambda data: LogProblem(
                read_log(data, thruster_model(), grid=False), logged_model(lag={"thrust": 0.02})
            ),
            "a model whose other constants do not follow from dt",
        ),
    ],
)
def test_what_needs_a_grid_says_so(call, rule):
    refused(rule, call, table(0.01 * np.arange(30)))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("rate", [100, 1000, 8])
def test_a_log_of_stamps_since_1970_is_the_log_of_times_since_zero(rate):
    """Stamps that float64 rounds divide no step."""
    times, found = np.arange(60) / rate, []
    for start in (0.0, 1.7e9):
        data = table(times) | {"time_s": start + times}
        found.append(estimate(data, "ekf", thruster_model(dt=1.0 / rate), grid=False, dt=1.0 / rate))
        inputs, measurements = in_steps(found[-1].log)
        assert len(inputs) == 59 and len(measurements) == 60
        np.testing.assert_allclose(inputs[:, 1], 1.0, rtol=1e-3)
    np.testing.assert_allclose(found[1].means, found[0].means, rtol=1e-2, atol=1e-3)


def test_two_channels_a_rounding_apart_share_a_row():
    ulp, start = np.spacing(1.7e9), 1.7e9
    times = 0.01 * np.arange(5)
    series = {
        "u": Series(times, np.ones(5)),
        "z": Series(times + ulp * np.array([0, 1, -1, 1, 0]), np.arange(5.0)),
    }
    for since, rows in ((start, 5), (0.0, 8)):
        stamps, columns = at_own_stamps(series, ["u"], {}, 0.01, float(times[-1]), since)
        assert len(stamps) == rows == len(columns["z"])


def test_a_log_whose_clock_was_set_is_refused_where_steps_are_counted():
    log = Log(
        "jump.csv", 0.01, np.zeros((3, 1)), np.zeros((4, 1)), (Quantity("u", "u"),), (Quantity("z", "z"),),
        stamps=np.array([0.0, 0.01, 0.02, 1.7e9]),
    )  # fmt: skip
    for use in (
        lambda: in_steps(log),
        lambda: by_the_clock(make_filter("ekf", thruster_model()), np.zeros(2), log, None),
    ):
        refused("at most 1000000 steps of 0.01 s apart", use)
