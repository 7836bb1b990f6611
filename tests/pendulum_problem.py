"""What a user writes to tune filters for Pendulum-v1: what they assume, and the env that makes the data."""

import math

from filters import StateSpaceModel
from tuning.problems.env_problem import EnvProblem
from tuning.problems.excitation import Steps
from tuning.problems.problem import Parameter

DT = 0.05
SENSORS = (0.01, 0.01, 0.25)  # variances of cosine, sine and rate


def swing(x, u, c):
    rate = x[1] + DT * (15.0 * math.sin(x[0]) + 3.0 * u[0])
    return (x[0] + DT * rate, rate)


def look(x, c):
    return (math.cos(x[0]), math.sin(x[0]), x[1])


def model(sigma=0.1, **changes):
    return StateSpaceModel(
        transition=swing, observe=look, process_noise_cov=[(DT * sigma) ** 2, sigma**2],
        measurement_noise_cov=SENSORS, prior_mean=[0.0, 0.0], prior_cov=[3.0, 0.5],
        states=[("angle", "theta", "rad", True), ("angular rate", "omega", "rad/s", False)],
        input_quantities=[("torque", "tau", "N m")],
        measurements=["cosine", "sine", ("measured rate", "rate", "rad/s")],
    ).replace(**changes)  # fmt: skip


def state(env):
    return env.state


def problem(assumed=None, **arguments):
    given = {"state_of": state, "measurement_noise_cov": SENSORS, "steps": 80, **arguments}
    return EnvProblem("Pendulum-v1", Steps(amplitude=2.0, hold=10), assumed or model(), **given)


def of_one_number(**arguments):
    return problem(model, parameters=[Parameter("sigma", 1e-3, 1.0, unit="rad/s")], **arguments)
