"""Real clocks: any dt, sensors at their own times, late samples in order; the same numbers as on a grid."""

import copy
import math
import pickle
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

from filters import make_filter, thruster_model
from filters.starts import FirstRestart
from tests.filters.checks import refused
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.model.continuous import ContinuousModel, noise_for_dt
from thruster_env.model.state_space import StateSpaceModel

A = np.array([[0.0, 1.0], [-4.0, -0.6]])
S = np.diag([0.01, 0.5])


class Constants(NamedTuple):
    substep: float
    stiffness: float = 4.0
    damping: float = 0.6


class Step(NamedTuple):
    dt: float


def rates(x, u, c):
    return x[1], u[0] - c.stiffness * x[0] - c.damping * x[1]


def both(x, c):
    return x[0], x[1]


def oscillator(**changes):
    arguments = {
        "prior_mean": [0.5, 0.0],
        "prior_cov": [0.3, 0.2],
        "measurement_noise_cov": [0.02, 0.1],
        "inputs": 1,
    }
    arguments |= {"measurements": ["position", "rate"]}
    return ContinuousModel(
        rates=rates, observe=both, densities=S, constants=Constants(0.01), arguments=arguments | changes
    )


def of_grid(filter_, inputs, z):
    session = filter_.session()
    session.start((0, 0), z[0])
    for u, one in zip(inputs, z[1:], strict=True):
        session.step(u, one)
    return session.mean.copy(), session.cov.copy()


def drawn(steps, channels, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(steps, 1)), rng.normal(size=(steps + 1, channels))


@pytest.mark.parametrize("name", ["ekf", "ukf", "enkf", "pf"])
def test_on_the_grid_it_is_the_session(name):
    filter_ = make_filter(name, thruster_model())
    inputs, z = drawn(30, 1)
    live = filter_.live(late=0.1)
    live.start(5.0, z[0])
    for k in range(30):
        live.predict_to(5.0 + 0.01 * (k + 1), 10 * inputs[k])
        live.update(5.0 + 0.01 * (k + 1), None, z[k + 1])
    mean, cov = of_grid(filter_, 10 * inputs, z)
    np.testing.assert_allclose(live.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(live.cov, cov, rtol=1e-9, atol=1e-15)
    assert live.time == pytest.approx(5.3) and live.divergences == 0


def test_any_dt_is_the_exact_filter_of_a_linear_plant():
    """Beside a Kalman filter by matrix exponentials, on the very stamps."""
    plant, rng = oscillator(), np.random.default_rng(1)
    live = make_filter("ekf", plant.at(0.02, substeps=4)).live(noise=plant.noise)
    live.start(0.0)
    x, p, t = np.array([0.5, 0.0]), np.diag([0.3, 0.2]), 0.0
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[1, 2] = A, 1.0
    for k in range(60):
        dt, u, sensor = rng.uniform(0.001, 0.1), rng.normal(), k % 2
        f = expm(whole * dt)
        t, x, p = t + dt, f[:2, :2] @ x + f[:2, 2] * u, f[:2, :2] @ p @ f[:2, :2].T + exact_noise(dt)
        z, r = x[sensor] + rng.normal(), (0.02, 0.1)[sensor]
        gain = p[:, sensor] / (p[sensor, sensor] + r)
        x, p = x + gain * (z - x[sensor]), p - np.outer(gain, p[sensor])
        live.predict_to(t, [u])
        live.update(t, ("position", "rate")[sensor], z)
        np.testing.assert_allclose(live.mean, x, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(live.cov, p, rtol=1e-6, atol=1e-10)


def exact_noise(dt, points=400):
    """int_0^dt e^{A s} S e^{A' s} ds by Gauss-Legendre."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    found = np.zeros((2, 2))
    for s, w in zip(0.5 * dt * (nodes + 1.0), 0.5 * dt * weights, strict=True):
        found += w * expm(A * s) @ S @ expm(A.T * s)
    return found


@pytest.mark.parametrize("dt", [0.001, 0.3, 2.0])
def test_van_loan_is_the_integral(dt):
    np.testing.assert_allclose(oscillator().noise(dt), exact_noise(dt), rtol=1e-6)
    np.testing.assert_allclose(oscillator().slope, A, atol=1e-7)
    if dt == 0.001:
        np.testing.assert_allclose(oscillator().noise(dt), noise_for_dt(S, 1.0, dt), rtol=2e-2, atol=1e-6)


@pytest.mark.parametrize(
    "name", slow_but(["ekf", "ukf", "enkf", "ekf-robust", "pf"], ["ekf", "ukf", "enkf", "ekf-robust"])
)
def test_late_samples_give_what_the_right_order_gives(name):
    plant = oscillator()
    filter_ = make_filter(name, plant.at(0.05))
    rng = np.random.default_rng(2)
    ticks = 0.05 * np.arange(1, 30)
    events = [(t, "predict", rng.normal()) for t in ticks]
    events += [(t, "position", rng.normal()) for t in ticks] + [(t - 0.013, "rate", rng.normal()) for t in ticks]
    arrival = [t + (0.31 if kind == "rate" else 0.0) for t, kind, _ in events]

    def followed(order, late):
        live = filter_.live(late=late)
        live.start(0.0, [0.4, 0.1])
        inputs = {t: u for t, kind, u in events if kind == "predict"}
        for place in order:
            t, kind, value = events[place]
            if kind == "predict":
                live.predict_to(t, [value])
            elif t > live.time:  # on time: under the input that acts
                live.predict_to(t, [inputs[min(one for one in inputs if one >= t)]])
                live.update(t, kind, value)
            else:
                live.update(t, kind, value)
        return live

    order = sorted(range(len(events)), key=lambda place: events[place][0])  # stable: predictions first
    by_arrival = sorted(range(len(events)), key=lambda place: arrival[place])
    early, late = followed(order, 0.0), followed(by_arrival, 0.4)
    each_close((late.mean, late.cov), (early.mean, early.cov), rtol=1e-9)
    assert len(late._events) < 60


def test_a_gap_is_gone_through_in_the_models_own_steps():
    model = thruster_model()
    live, session = make_filter("ekf", model).live(), make_filter("ekf", model).session()
    live.start(0.0, [0.2])
    session.start((0, 0), [0.2])
    live.predict_to(1.0, [12.0])
    for _ in range(100):
        session.step([12.0], [math.nan])
    each_close((live.mean, live.cov), (session.mean, session.cov), rtol=1e-9)


def test_a_monitor_watches_what_comes_in():
    live = make_filter("ekf", thruster_model()).live(monitor={"stuck": 3})
    live.start(0.0)
    for k in range(1, 6):
        live.predict_to(0.01 * k, [3.0])
        live.update(0.01 * k, "thrust", 0.25)
        found = [one.test for one in live.health.alarms]
        assert ("stuck" in found) == (k == 3)


def started(**options):
    live = make_filter("ekf", thruster_model()).live(**options)
    live.start(1.0)
    live.predict_to(1.02, [4.0])
    return live


@pytest.mark.parametrize(
    "call, rule",
    [
        (lambda live: live.predict_to(1.0, [4.0]), "time must not step back behind 1.02 s, but got 1"),
        (lambda live: live.predict_to(math.inf, [4.0]), "time must be a finite number"),
        (lambda live: live.predict_to(1.03), "u must be 1 finite numbers, but got None"),
        (lambda live: live.update(1.0, "thrust", 0.1), "at most late = 0 s late, but one of 1 s came at 1.02 s"),
        (lambda live: live.update(1.02, "speed", 0.1), "sensor must be .*thrust, but got 'speed'"),
        (lambda live: live.update(1.02, None, [0.1, 0.2]), "z must have a number for each of thrust"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(call, rule):
    refused(rule, call, started())


def test_samples_from_before_the_start_nan_and_models_without_a_dt_are_refused():
    with pytest.raises(ValueError, match="must not be earlier than the start, but got one at 0.9 s"):
        started(late=5.0).update(0.9, "thrust", 0.1)
    with pytest.raises(ValueError, match="z must not be NaN with skip_missing=False"):
        started(skip_missing=False).update(1.02, "thrust", math.nan)
    skipped = started()
    before = skipped.mean.copy()
    skipped.update(1.02, "thrust", math.nan)
    np.testing.assert_array_equal(skipped.mean, before)
    with pytest.raises(ValueError, match=r"start\(time\) must come before"):
        make_filter("ekf", thruster_model()).live().predict_to(1.0, [0.0])
    with pytest.raises(ValueError, match="must give the input before a sample at 2 s"):
        live = make_filter("ekf", thruster_model()).live()
        live.start(1.0)
        live.update(2.0, "thrust", 0.1)
    with pytest.raises(ValueError, match="'kf-steady' has the A and B of one dt: 'ekf' is the Kalman filter at"):
        make_filter("kf-steady", thruster_model()).live()


def test_a_channel_may_have_a_function_of_its_own():
    whole = oscillator()
    parts = {"position": lambda x, c: x[0], "rate": lambda x, c: x[1]}
    arguments = {name: value for name, value in whole.arguments.items() if name != "measurements"}
    named = {"constants": Constants(0.01), "arguments": arguments}
    plant = ContinuousModel(rates=rates, observe=parts, densities=S, **named)
    assert plant.at(0.05).digest == whole.at(0.05).digest
    assert [one.symbol for one in plant.at(0.05).measurements] == ["position", "rate"]
    live = make_filter("ekf", plant.at(0.05)).live(noise=plant.noise)
    live.start(0.0)
    live.update(0.0, "rate", 0.7)
    assert live.mean[1] == pytest.approx(0.7 * 0.2 / 0.3) and live.mean[0] == pytest.approx(0.5)


def test_long_steps_are_divided_as_far_as_accuracy_asks():
    plant = ContinuousModel.of(oscillator().at(0.02, substeps=2), rates)
    assert [plant.at(dt).substeps for dt in (0.005, 0.01, 0.02, 0.025, 1.0)] == [1, 1, 2, 3, 100]
    np.testing.assert_allclose(plant.densities, S, rtol=1e-6, atol=1e-9)


def test_noise_of_no_white_noise_is_refused():
    with pytest.raises(ValueError, match="process_noise_cov must be that of white noise in continuous time"):
        noise_for_dt([0.0, 1.0], 0.1, 0.2, A)
    q = exact_noise(0.3)
    np.testing.assert_allclose(noise_for_dt(q, 0.3, 1.7, A), exact_noise(1.7), rtol=1e-9)


def test_a_continuous_model_needs_a_substep():
    with pytest.raises(ValueError, match="constants must be a NamedTuple with a field substep"):
        ContinuousModel(rates=rates, observe=both, densities=S, constants=(), arguments={"prior_mean": [0.0, 0.0]})


def watched(filter_, samples, late, **monitor):
    """Live with a monitor over samples (stamp, arrival, channel, value); the alarms at each arrival."""
    live = filter_.live(late=late, monitor={"steps_between": 100_000.0, **monitor})
    live.start(0.0)
    alarms = []
    for _, arrival, channel, value, stamp in sorted((one[1], one[1], one[2], one[3], one[0]) for one in samples):
        if arrival > live.time:
            live.predict_to(arrival, [0.0])
        live.update(stamp, channel, value)
        alarms += live.health.alarms
    return live, alarms


def samples_of(plant, steps, delay, bias=0.0, dt=0.05):
    """Readings of a run under process noise: the position at once, the rate `delay` steps later."""
    rng, model = np.random.default_rng(11), plant.at(dt)
    root, x, found = np.linalg.cholesky(model.process_noise_cov), np.array([0.5, 0.0]), []
    for k in range(1, steps):
        x = np.array(model.transition(tuple(x), (0.0,), model.constants)) + root @ rng.normal(size=2)
        rate = x[1] + math.sqrt(0.1) * rng.normal() + bias * (k >= steps // 2)
        found.append((dt * k, dt * k, "position", x[0] + math.sqrt(0.02) * rng.normal()))
        found.append((dt * k, dt * (k + delay), "rate", rate))
    return found


@pytest.mark.usefixtures("as_python")
def test_a_monitor_sees_late_samples_in_the_order_of_their_stamps():
    plant = oscillator()
    filter_ = make_filter("ekf", plant.at(0.05))
    _, none = watched(filter_, samples_of(plant, 300, 3), 0.4)
    assert none == []  # 29 in 1500 steps, when it saw the innovation of the newest sample beside the late one
    late, found = watched(filter_, samples_of(plant, 120, 3, bias=3.0), 0.4)
    early, expected = watched(filter_, samples_of(plant, 120, 0, bias=3.0), 0.0)
    assert {one.test for one in found} & {"cusum", "glr", "outlier"}
    assert {(one.test, one.channel) for one in found} == {(one.test, one.channel) for one in expected}
    np.testing.assert_allclose(late._watch._state, early._watch._state, rtol=1e-6, atol=1e-6)
    assert len(found) == len(set(found))  # none is raised once more when it is gone through again


@pytest.mark.usefixtures("as_python")
def test_late_samples_of_one_stamp_come_in_the_order_of_arrival_with_the_length_of_their_step():
    plant = oscillator()
    filter_ = make_filter("ekf", plant.at(0.05))
    late, early = filter_.live(late=1.0), filter_.live()
    for live in (late, early):
        live.start(0.0)
        live.predict_to(0.03, [1.0])
    for live in (early,):
        for channel, value in (("position", 0.4), ("rate", 0.3), ("position", 0.7)):
            live.update(0.03, channel, value)
        live.predict_to(0.2, [2.0])
        live.update(0.2, "position", 0.1)
    late.update(0.03, "position", 0.4)
    late.predict_to(0.2, [2.0])
    late.update(0.2, "position", 0.1)
    late.update(0.03, "rate", 0.3)
    late.update(0.03, "position", 0.7)
    each_close((late.mean, late.cov), (early.mean, early.cov), rtol=1e-12)


@pytest.mark.usefixtures("as_python")
def test_a_copy_of_live_has_its_own_estimate():
    live = make_filter("ekf", thruster_model()).live(late=0.5, monitor=1000)
    live.start(1.0)
    live.predict_to(1.02, [4.0])
    for other in (copy.deepcopy(live), pickle.loads(pickle.dumps(live))):
        before = live.mean.copy()
        other.update(1.02, "thrust", 3.0)
        np.testing.assert_array_equal(live.mean, before)
        assert (other.mean != before).any() and not np.shares_memory(other.mean, live.mean)


@pytest.mark.parametrize("start", [0.0, 1.7e9, -1.7e9])
@pytest.mark.parametrize("rate", [100.0, 1000.0])
@pytest.mark.usefixtures("as_python")
def test_stamps_since_1970_divide_no_step(start, rate):
    dt = 1.0 / rate
    filter_ = make_filter("ekf", oscillator().at(dt))
    live, session = filter_.live(), filter_.session()
    live.start(start)
    session.start((0, 0), [math.nan, math.nan])
    rng = np.random.default_rng(12)
    for k in range(1, 120):
        u, z = rng.normal(size=1), rng.normal(size=2)
        live.predict_to(start + k * dt, u)
        live.update(start + k * dt, None, z)
        session.step(u, z)
        assert live._session.belief().step == k
    np.testing.assert_allclose(live.mean, session.mean, rtol=1e-3, atol=1e-4)


@pytest.mark.usefixtures("as_python")
def test_a_long_gap_costs_predictions_alone_and_says_where_a_restart_began(monkeypatch):
    """The covariance of x' = x^2 overflows in step 113 of 120: the step that is told, not the last one."""
    model = StateSpaceModel(
        transition=lambda x, u, c: (x[0] + c.dt * x[0] * x[0],),
        observe=lambda x, c: (x[0],),
        process_noise_cov=[1e-4],
        measurement_noise_cov=[0.1],
        prior_mean=[1.0],
        prior_cov=[1e-4],
        constants=Step(0.01),
        inputs=1,
    )
    live = make_filter("ekf", model).live()
    live.start(0.0)
    live.predict_to(1.2, [0.0])
    live.update(1.2, None, [0.5])
    assert live.divergences == 1
    assert (live.restarts.states, live.restarts.cause) == (("x_1",), "the covariance overflows in the prediction")
    copies = []
    monkeypatch.setattr(FirstRestart, "hold", lambda self, session: copies.append(1))
    calm = make_filter("ekf", oscillator().at(0.01)).live()
    calm.start(0.0)
    calm.predict_to(20.0, [1.0])
    assert len(copies) <= 3


@pytest.mark.usefixtures("as_python")
def test_a_clock_that_jumps_is_an_error_of_one_line_and_nothing_changes():
    live = make_filter("ekf", thruster_model()).live(late=1.0)
    live.start(0.0)
    live.predict_to(0.02, [1.0])
    before = live.mean.copy()
    for use in (lambda: live.predict_to(1.7e9, [1.0]), lambda: live.update(1.7e9, "thrust", 0.1)):
        refused("at most 1000000 steps of 0.01 s apart, but are .*start anew", use)
    np.testing.assert_array_equal(live.mean, before)
    live.update(0.02, "thrust", 0.1)  # goes on
    live.start(1.7e9)
    live.predict_to(1.7e9 + 0.01, [1.0])


@pytest.mark.usefixtures("as_python")
def test_stamps_of_a_coarse_recorder_are_one_within_its_resolution():
    live = make_filter("ekf", thruster_model()).live(resolution=0.001)
    live.start(1.0)
    live.predict_to(1.011, [4.0])
    assert live._session.belief().step == 1
    live.predict_to(1.0105, [4.0])  # of the same time
    live.update(1.0115, "thrust", 0.2)
    assert live.time == 1.011


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_a_filter_that_learns_q_takes_steps_as_long_as_the_models_alone(start):
    live = make_filter("sage-husa", oscillator().at(0.01), process_forgetting_factor=0.99).live()
    live.start(start)
    for k in range(1, 40):
        live.predict_to(start + 0.01 * k, [0.1])
        live.update(start + 0.01 * k, "position", 0.4)
    with pytest.raises(ValueError, match="Q and R of the filter 'sage-husa' cannot vary from step to step"):
        live.predict_to(start + 0.395, [0.1])
