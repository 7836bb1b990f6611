"""Altitude of a small drone from an accelerometer, a barometer and a range finder: four numbers to be tuned.

    z' = v,   v' = a - b,   b a random walk;   a is the accelerometer's reading less gravity, and the input

The accelerometer's noise sigma_a acts on z and v together and only that of the bias comes beside it, so Q is
singular:

    Q = sigma_a^2 g g' + diag(0, 0, sigma_b^2),   g = (dt^2/2, dt, 0)

What I had: the numbers of four data sheets, with the accelerometer's doubled for its vibrating frame. The
barometer's 0.1 m and the range finder's 2 cm were meant for still air and a white wall. The truth has the same
equations and other numbers.

Source: the model is that of any strapdown text (J. A. Farrell (2008), Aided Navigation); the numbers are of the
order of MEMS parts: an accelerometer on a vibrating frame, a barometer in turbulent air, an optical range finder
of 5 cm.
"""

import numpy as np

from filters import affine_model
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter

DT = 0.02  # [s]


def model(sigma_a=0.1, sigma_b=1e-3, r_barometer=0.01, r_range=4e-4):
    """Altitude, climb rate and bias of the accelerometer.

    Arguments: deviation of the accelerometer [m/s^2], of the bias's walk a step [m/s^2], variances of barometer
    and range finder [m^2].
    """
    g = np.array([DT**2 / 2, DT, 0.0])
    return affine_model(
        a=[[1.0, DT, -(DT**2) / 2], [0.0, 1.0, -DT], [0.0, 0.0, 1.0]],
        b=g[:, None],
        c=[[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
        process_noise_cov=sigma_a**2 * np.outer(g, g) + np.diag([0.0, 0.0, sigma_b**2]),
        measurement_noise_cov=[r_barometer, r_range],
        prior_mean=[0.0, 0.0, 0.0],
        prior_cov=[1.0, 0.25, 0.04],
        states=[("altitude", "z", "m"), ("climb rate", "v", "m/s"), ("accelerometer's bias", "b", "m/s^2")],
        input_quantities=[("accelerometer less gravity", "a", "m/s^2")],
        measurements=[("barometer", "z_b", "m"), ("range finder", "z_r", "m")],
    )


problem = ModelProblem(
    model(sigma_a=0.05, sigma_b=1e-3, r_barometer=0.5, r_range=2.5e-3),
    model,
    inputs={"name": "multi-sine", "amplitude": 0.5, "periods": [5.0, 2.3, 0.7]},
    steps=400,
    dt=DT,
    scale=(0.015, 0.03, 0.04),  # about what a good filter has
    parameters=[
        Parameter("sigma_a", 1e-3, 10.0, unit="m/s^2"),
        Parameter("sigma_b", 1e-5, 1.0, unit="m/s^2"),
        Parameter("r_barometer", 1e-3, 10.0, unit="m^2"),
        Parameter("r_range", 1e-5, 1.0, unit="m^2"),
    ],
    name="altitude",
    about="a drone's altitude, climb rate and accelerometer bias; four numbers, singular Q",
)
