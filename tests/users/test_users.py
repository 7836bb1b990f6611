"""The panel of users' problems: each is what its page says, and a filter runs on it with what its user had."""

import importlib
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from filters import make_filter
from tests.users import (
    altitude,
    battery,
    chain,
    compartments,
    geared_motor,
    heat_exchanger,
    lateral,
    lidar,
    lorenz63,
    pendulum,
    range_bearing,
    reactor,
)
from tuning.evaluation.evaluate import evaluate
from tuning.experiments.users import PANEL, found_problems, name_of

PAGES = (
    *(altitude, battery, chain, compartments, geared_motor, heat_exchanger, lateral, lidar, lorenz63, pendulum),
    *(range_bearing, reactor),
)
SEEDS = range(2000, 2008)
FEW = 20  # runs that decide a statistic
QUICK = (altitude, pendulum, lorenz63)  # an affine one, one of an env with an angle, and one of rates


def named(page):
    return page.__name__.rpartition(".")[2]


def of_filters(pages):
    """Pages as parameters: of most, filters are compiled in the slow tests only."""
    marks = {page: [] if page in QUICK else pytest.mark.slow for page in pages}
    return pytest.mark.parametrize("page", [pytest.param(one, id=named(one), marks=marks[one]) for one in pages])


every_page = pytest.mark.parametrize("page", PAGES, ids=named)


def of_models(pages):
    return [page for page in pages if hasattr(page.problem, "truth")]


def known(page):
    """The EKF that knows the plant's equations, Q and R."""
    return make_filter("ekf", page.problem.truth)


def test_every_page_is_in_the_panel():
    files = {path.stem for path in Path(__file__).parent.glob("*.py")} - {"__init__", "test_users"}
    assert files == {named(page) for page in PAGES} and len(files) >= 12
    assert PANEL == tuple(f"tests.users.{one}:problem" for one in sorted(files))


@pytest.mark.slow
def test_every_problem_of_the_panel_passes_the_checks_of_a_problem():
    assert [name_of(problem) for problem in found_problems(PANEL)] == sorted(map(named, PAGES))


@of_filters(PAGES)
def test_a_filter_runs_with_what_its_user_had(page, request):
    if page not in QUICK and named(page) != "reactor":  # its substeps take minutes in Python
        request.getfixturevalue("as_python")
    problem = page.problem
    data = problem.data(SEEDS)
    found = evaluate(make_filter("ekf", problem.model()), data, problem.scale)
    assert found.divergences == 0
    # Wrong, as guesses are, and not absurd: a barometer seven times as bad as its sheet makes the NIS 28.
    assert 0.3 < found.nis.value / found.expected_nis < 50.0
    spread = np.ptp(data.states, axis=(0, 1))
    for one, width in zip(found.rmse, spread, strict=True):
        assert one.value < width


@of_filters(of_models(PAGES))
def test_who_knows_the_plant_is_consistent_and_better_than_its_user(page):
    problem = page.problem
    data = problem.data(range(3000, 3000 + FEW))
    user = evaluate(make_filter("ekf", problem.model()), data, problem.scale)
    best = evaluate(known(page), data, problem.scale)
    assert best.score.value < 1.001 * user.score.value  # the user of Lorenz-63 has the right ratio of Q to R
    # Mean of the squares of some 10^4 normal innovations; linearisation adds a little on the nonlinear ones.
    assert best.nis.value / best.expected_nis == pytest.approx(1.0, abs=0.06)


@of_filters([page for page in PAGES if hasattr(page, "rates")])
def test_a_step_is_the_integral_of_the_rates(page):
    model = getattr(page.problem, "truth", None) or page.problem.model()
    data, c = page.problem.data(range(2)), model.constants
    n = len(page.rates(tuple(data.states[0, 0].tolist()), tuple(data.inputs[0, 0].tolist()), c))
    scale = np.ptp(data.states, axis=(0, 1))[:n] / 100.0
    for k in (0, 60, 130):
        start, u = data.states[1, k].tolist(), tuple(data.inputs[1, k].tolist())
        x = tuple(start)
        for _ in range(model.substeps):
            x = model.transition(x, u, c)
        seconds = c.substep * model.substeps
        exact = solve_ivp(
            lambda t, y, u=u: page.rates(tuple(y), u, c), (0.0, seconds), start[:n], rtol=1e-10, atol=1e-12
        )
        np.testing.assert_allclose(np.array(x)[:n] / scale, exact.y[:, -1] / scale, atol=1e-2)


def test_altitude_is_that_of_a_constant_acceleration_and_q_has_rank_two():
    model = altitude.model()
    x = (0.0, 0.0, 0.3)
    for _ in range(100):
        x = tuple(float(part) for part in model.transition(x, (1.5,), model.constants))
    np.testing.assert_allclose(x, (0.5 * 1.2 * 2.0**2, 1.2 * 2.0, 0.3), rtol=1e-12)
    assert np.linalg.matrix_rank(model.process_noise_cov) == 2


def test_the_reactor_stands_where_the_textbook_says():
    np.testing.assert_allclose(reactor.rates((0.5, 350.0), (300.0,), reactor.Constants()), (0.0, 0.0), atol=0.02)


def test_the_motor_turns_as_fast_as_its_back_emf_lets_it():
    c, volts = geared_motor.Constants(), 6.0
    gear = c.torque * c.ratio
    speed = gear * volts / (c.resistance * c.viscous + gear**2)
    state = (c.ratio * speed, c.viscous * speed / c.stiffness, speed, 0.0)
    np.testing.assert_allclose(geared_motor.rates(state, (volts,), c), (0.0, 0.0, 0.0, speed), atol=1e-9)
    slower = geared_motor.rates(state, (volts,), c._replace(dry=0.3))
    assert slower[2] == pytest.approx(-0.3 / c.load, rel=1e-6)


def test_a_ship_that_turns_all_around_is_back():
    x, turn = (100.0, 50.0, 8.0, 0.4, 2.0 * math.pi / 600.0), range_bearing.Constants()
    begun = x
    for _ in range(200):
        x = range_bearing.move(x, (), turn)
    np.testing.assert_allclose(x[:2], begun[:2], atol=1e-9)
    assert range_bearing.look((-3.0, 4.0), turn) == pytest.approx((5.0, math.pi - math.atan(4.0 / 3.0)))


def test_a_chain_of_equal_springs_has_the_textbooks_frequencies():
    a, _ = chain.equations()
    damped = np.linalg.eigvals(a)
    squares = np.sort(np.abs(damped) ** 2)[::2]  # of a pair: stiffness over mass, whatever the damping
    modes = 4.0 * chain.STIFFNESS / chain.MASS * np.sin(np.arange(1, 6) * np.pi / 12.0) ** 2
    np.testing.assert_allclose(squares, modes, rtol=1e-9)
    at, bt = chain.over_a_step()
    exact = solve_ivp(
        lambda t, y: a @ y + chain.equations()[1][:, 0], (0.0, chain.DT), np.ones(10), rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose(at @ np.ones(10) + bt[:, 0], exact.y[:, -1], rtol=1e-8)
    assert np.linalg.matrix_rank(chain.problem.model().process_noise_cov) == 5


def test_lorenz_rests_at_his_fixed_points():
    c = lorenz63.Constants()
    root = math.sqrt(c.beta * (c.rho - 1.0))
    for point in ((0.0, 0.0, 0.0), (root, root, c.rho - 1.0), (-root, -root, c.rho - 1.0)):
        np.testing.assert_allclose(lorenz63.move(point, (), c), point, atol=1e-12)


def test_the_env_swings_as_the_model_does_but_for_gravity():
    model, (x,) = pendulum.model(gravity=10.0), pendulum.problem.data([5]).states
    inputs = pendulum.problem.data([5]).inputs[0]
    free = np.abs(x[1:, 1]) < 8.0  # where the env does not cut the rate
    assert free.sum() > 50
    for k in np.flatnonzero(free):
        np.testing.assert_allclose(
            pendulum.swing(tuple(x[k]), tuple(inputs[k]), model.constants), x[k + 1], atol=1e-6
        )


def test_the_lidar_scatters_in_range_and_bearing():
    data = lidar.problem.data(range(200))
    where, seen = data.states[..., :2], data.measurements
    turn = np.arctan2(seen[..., 1], seen[..., 0]) - np.arctan2(where[..., 1], where[..., 0])
    bearing = (turn + np.pi) % (2.0 * np.pi) - np.pi
    distance = np.hypot(*np.moveaxis(seen, -1, 0)) - np.hypot(*np.moveaxis(where, -1, 0))
    for errors, sigma in ((distance, 2.0), (bearing, 1.5 * np.pi / 180.0)):
        count = errors.size
        low, high = chi2.ppf([5e-5, 1.0 - 5e-5], count)
        assert low < np.square(errors / sigma).sum() < high
    steps = np.diff(data.states, axis=1)
    speed, change = (
        np.hypot(*np.moveaxis(data.states[..., 2:], -1, 0)),
        np.hypot(*np.moveaxis(steps[..., 2:], -1, 0)),
    )
    assert speed[:, 0].min() >= 30.0 and speed[:, 0].max() <= 90.0 and change.max() < 15.0 + 5.0 * 2.0


def test_what_leaves_the_body_is_what_the_liver_takes():
    c, x = compartments.Constants(), (3.0, 2.0, 0.5, 2.5)
    blood, fast, slow, _ = compartments.rates(x, (10.0,), c)
    volumes = c.volume * np.array([1.0, c.k12 / c.k21, c.k13 / c.k31])
    assert volumes @ (blood, fast, slow) == pytest.approx(10.0 - c.k10 * c.volume * x[0])
    assert compartments.look((0.0, 0.0, 0.0, 3.4), c) == (50.0,) and compartments.look((0.0,) * 4, c) == (100.0,)


def test_a_cell_is_empty_after_its_capacity():
    c, x = battery.Constants(), (1.0, 0.0, 0.0, 0.0)
    for _ in range(720):
        x = battery.move(x, (0.85,), c)
    assert x[0] == pytest.approx(0.0, abs=1e-9) and x[3] == 0.85
    np.testing.assert_allclose(x[1:3], (0.85 * c.short, 0.85 * c.long), rtol=1e-5)  # both pairs have settled
    assert battery.open_circuit(1.0) == pytest.approx(4.103, abs=1e-3)
    assert battery.look(x, c)[0] == pytest.approx(2.654 - 0.85 * (c.short + c.long + c.series), abs=1e-3)


def test_heat_that_one_flow_loses_the_other_gains():
    c, flows = heat_exchanger.Constants(), (0.3, 0.2)
    x = (70.0, 60.0, 50.0, 48.0, 35.0, 22.0, 1400.0)
    change = c.mass * c.heat * sum(heat_exchanger.rates(x, flows, c)[:6])
    brought = c.heat * (flows[0] * (c.hot - x[2]) + flows[1] * (c.cold - x[3]))
    assert change == pytest.approx(brought)
    answered = ~np.isnan(heat_exchanger.problem.data(range(10)).measurements)
    assert answered[..., 0].all()
    of_third = answered[:, ::3, 1]
    assert not answered[:, 1::3, 1].any() and of_third.mean() == pytest.approx(0.8, abs=0.07)


def test_a_car_yaws_by_its_understeer():
    c = lateral.Constants(lateral.DT, 8e4, 9e4, 0.0)
    base, wheel = c.to_front + c.to_rear, 0.01
    understeer = c.mass / base * (c.to_rear / c.front - c.to_front / c.rear)
    yaw = c.speed * wheel / (base + understeer * c.speed**2)
    slip_rear = c.mass * c.to_front / base * c.speed * yaw / c.rear
    sideways = c.to_rear * yaw - slip_rear * c.speed
    np.testing.assert_allclose(lateral.rates((sideways, yaw, wheel, 0.0, 0.0), (wheel,), c), [0.0] * 5, atol=1e-9)
    gripping = lateral.force(8e4, 0.5, 6000.0)
    assert gripping == pytest.approx(-6000.0, abs=0.1) and lateral.force(8e4, 1e-4, 6000.0) == pytest.approx(
        -8.0, rel=1e-5
    )


@every_page
def test_a_page_is_a_page(page):
    lines = Path(importlib.import_module(page.__name__).__file__).read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 125 and "What I had:" in "\n".join(lines)
