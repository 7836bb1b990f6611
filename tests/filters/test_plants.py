"""Vehicles and machines by name, and matrices by letters: against independent equations, and read with logs."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import filters
from filters import plants
from tuning.logs.read import model_of_logs, read_named

CASES = {  # an input, a state, and the rates there by hand
    "coordinated-turn": ([], [3.0, -2.0, 4.0, 0.3, 0.2], [4 * math.cos(0.3), 4 * math.sin(0.3), 0.0, 0.2, 0.0]),
    "unicycle": ([2.0, 0.4], [3.0, -2.0, 0.3], [2 * math.cos(0.3), 2 * math.sin(0.3), 0.4]),
    "bicycle": ([2.0, 0.1], [0.0, 0.0, 0.3], [2 * math.cos(0.3), 2 * math.sin(0.3), 2 * math.tan(0.1) / 2.7]),
    "pendulum": ([0.7], [0.5, -0.2], [-0.2, -9.81 * math.sin(0.5) + 0.02 + 0.7]),
    "dc-motor": ([3.0], [0.1, 5.0], [5.0, (30.0 - 5.0 - 0.5 * math.tanh(5.0)) / 0.1]),
    "battery": ([2.0], [0.5, 0.03], [-2.0 / 9000.0, (0.04 - 0.03) / 30.0]),
    "tank": ([0.02], [1.5], [0.02 - 0.01 * math.sqrt(2 * 9.81 * 1.5)]),
    "rc-thermal": ([2000.0, 5.0], [21.0], [((5.0 - 21.0) / 0.005 + 2000.0) / 5e6]),
}


@pytest.mark.parametrize("name", CASES)
def test_rates_and_a_step_are_those_of_the_equations(name):
    u, x, rates = CASES[name]
    plant = plants.PLANTS[name]()
    model = plant.at(plant.longest)
    np.testing.assert_allclose(plant.rates(x, u, plant.constants), rates, rtol=1e-12)
    exact = solve_ivp(
        lambda t, at: plant.rates(at, u, plant.constants), (0.0, plant.longest), x, rtol=1e-11, atol=1e-12
    ).y[:, -1]
    np.testing.assert_allclose(model.transition(tuple(x), tuple(u), model.constants), exact, rtol=1e-5, atol=1e-6)
    assert model.n == len(x) and model.inputs == len(u)


def test_range_and_bearing_are_those_from_the_sensor():
    for make in (plants.coordinated_turn, plants.unicycle, plants.bicycle):
        plant = make(sensors="range-bearing", sensor_x=1.0, sensor_y=2.0)
        model, x = plant.at(0.1), (4.0, 6.0, 0.0, 0.0, 0.0)
        np.testing.assert_allclose(model.observe(x, model.constants), (5.0, math.atan2(4.0, 3.0)), rtol=1e-12)
        assert model.measurements[1].angle and plant.arguments["measurement_noise_cov"][1] == 1e-4
    with pytest.raises(ValueError, match="sensors must be one of position, range-bearing"):
        plants.unicycle(sensors="radar")


def test_the_voltage_of_a_battery_is_that_of_its_table_and_current():
    plant = plants.battery(open_circuit=[(0.0, 3.0), (1.0, 4.0)])
    model = plant.at(1.0)
    assert model.observe((0.25, 0.1), (2.0,), model.constants)[0] == pytest.approx(3.25 - 0.1 - 0.06, rel=1e-12)
    assert model.functions == plants.battery(open_circuit=[(0.0, 3.0), (1.0, 4.0)]).at(1.0).functions
    with pytest.raises(ValueError, match="open_circuit must ascend"):
        plants.battery(open_circuit=[(0.0, 3.0), (0.5, 2.9)])


def test_noise_has_the_density_of_what_it_moves():
    model = plants.pendulum(length=0.5, mass=2.0, torque=0.3).at(1e-4)
    np.testing.assert_allclose(model.process_noise_cov[1, 1], 1e-4 * (0.3 / 0.5) ** 2, rtol=1e-3)
    room = plants.rc_thermal().at(60.0)
    np.testing.assert_allclose(room.process_noise_cov[0, 0], 60.0 * (1e4 / 5e6) ** 2, rtol=0.01)


def test_a_filter_follows_a_swinging_pendulum(as_python):
    plant = plants.pendulum(length=0.8, torque=0.02)
    model, rng = plant.at(0.05), np.random.default_rng(1)
    x, z, truth = (1.2, 0.0), [], []
    for _ in range(60):
        truth.append(x)
        z.append(x[0] + 0.01 * rng.normal())
        for _ in range(model.substeps):
            x = model.transition(x, (0.0,), model.constants)
    estimates = filters.run(filters.make_filter("ekf", model), inputs=np.zeros(59), measurements=z)
    np.testing.assert_allclose(estimates.means[10:], truth[10:], atol=0.1)


def test_matrices_have_the_letters_that_users_know():
    f, h, q, r, p = [[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.0]], [0.01, 0.1], [0.25], [10.0, 1.0]
    written = filters.affine_model(F=f, H=h, Q=q, R=r, P0=p)
    plain = filters.affine_model(
        a=f,
        b=np.zeros((2, 0)),
        c=h,
        process_noise_cov=q,
        measurement_noise_cov=r,
        prior_mean=[0.0, 0.0],
        prior_cov=p,
    )
    np.testing.assert_array_equal(written.numbers, plain.numbers)
    driven = filters.affine_model(A=f, B=[[0.0], [0.1]], C=h, D=[[0.0]], Q=q, R=r, x0=[1.0, 0.0], P0=p)
    assert driven.inputs == 1 and driven.prior_mean[0] == 1.0
    with pytest.raises(ValueError, match="a must be given once, but got F, too"):
        filters.affine_model(a=f, F=f, H=h, Q=q, R=r, P0=p)


def read(log, model):
    return read_named(log, model=model_of_logs(log, model, None)[1])[0]


def test_a_log_is_read_with_a_plant_by_name_or_a_file_of_matrices(tmp_path):
    log, file = tmp_path / "swing.csv", tmp_path / "matrices.toml"
    rows = [f"{0.1 * k:.1f},{math.sin(k):.3f},{math.cos(k):.3f}" for k in range(30)]
    log.write_text("\n".join(["t,encoder,tau", *rows]))
    runs = read(log, "pendulum")
    assert runs.measurements[1, 0] == 0.841 and runs.inputs[1, 0] == 0.54 and runs.dt == pytest.approx(0.1)
    file.write_text(
        """
F = [[1.0, 0.1], [0.0, 1.0]]
B = [[0.0], [0.1]]
H = [[1.0, 0.0]]
Q = [0.01, 0.1]
R = [0.25]
P0 = [10.0, 1.0]
measurements = [["encoder", "z", "rad"]]
inputs = [["tau", "tau", "N m"]]
"""
    )
    runs = read(log, file)
    assert runs.measurements[1, 0] == 0.841 and runs.inputs[1, 0] == 0.54
    file.write_text("F = [[1.0, 0.1]]\nH = [[1.0]]\nQ = [1.0]\nR = [1.0]\nP0 = [1.0]\n")
    with pytest.raises(ValueError, match=r"a, b, c must have shapes .*matrices.toml"):
        read(log, file)
