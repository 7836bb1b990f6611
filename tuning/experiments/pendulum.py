"""Gymnasium's Pendulum-v1 seen through noise: from a user's file to a tuned filter around the env.

    thruster tune --problem tuning.experiments.pendulum:problem --filter ekf --trials 30 --out pendulum.json
    thruster report pendulum.json --problem tuning.experiments.pendulum:problem
    env = EstimateState(gym.make("Pendulum-v1"), tuned="pendulum.json", model=pendulum.model())

Filters take 9.81 m/s^2 for gravity, where the env has 10: what is tuned is how little they trust themselves.
"""

import math

from filters import StateSpaceModel
from tuning.problems.env_problem import EnvProblem
from tuning.problems.excitation import Steps
from tuning.problems.problem import Parameter

DT = 0.05
VARIANCES = (0.01, 0.01, 0.25)  # of cosine, sine and rate


def swing(x, u, c):
    """The angle from upright and its rate one step later."""
    rate = x[1] + DT * (1.5 * 9.81 * math.sin(x[0]) + 3.0 * u[0])
    rate = min(max(rate, -8.0), 8.0)
    return (x[0] + DT * rate, rate)


def look(x, c):
    """What the sensors show."""
    return (math.cos(x[0]), math.sin(x[0]), x[1])


def model(sigma=0.1):
    """What filters assume, with noise of the rate of sigma [rad/s] a step."""
    return StateSpaceModel(
        transition=swing,
        observe=look,
        process_noise_cov=[(DT * sigma) ** 2, sigma**2],
        measurement_noise_cov=VARIANCES,
        prior_mean=[0.0, 0.0],
        prior_cov=[3.0, 0.5],
        states=[("angle", "theta", "rad", True), ("angular rate", "omega", "rad/s")],
        input_quantities=[("torque", "tau", "N m")],
        measurements=["cosine", "sine", ("measured rate", "rate", "rad/s")],
    )


def state(env):
    """The truth."""
    return env.state


problem = EnvProblem(
    "Pendulum-v1",
    Steps(amplitude=2.0, hold=10),
    model,
    state_of=state,
    measurement_noise_cov=VARIANCES,
    parameters=[Parameter("sigma", 1e-3, 1.0, unit="rad/s", default=0.3)],
)
