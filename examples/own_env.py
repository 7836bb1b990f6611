"""
An env of your own
==================

Any Gymnasium env can be a problem: it generates the data, and you define the model that filters assume. Here
it is Gymnasium's pendulum, with noisy sensors for cosine, sine and rate.
"""

# %%
# What filters assume
# -------------------
#
# The env has its own equations; the filter has these. Q covers what the model leaves out.

import math

import tuning
from filters import EstimateState, StateSpaceModel
from tuning.problems.env_problem import EnvProblem
from tuning.problems.excitation import Steps

TRIALS = 25
DT = 0.05  # [s]
SENSORS = (0.01, 0.01, 0.25)  # variances of cosine, sine and rate


def swing(x, u, c):
    rate = x[1] + DT * (15.0 * math.sin(x[0]) + 3.0 * u[0])
    return x[0] + DT * rate, rate


def look(x, c):
    return math.cos(x[0]), math.sin(x[0]), x[1]


def pendulum():
    return StateSpaceModel(
        transition=swing,
        observe=look,
        process_noise_cov=[2.5e-5, 0.01],
        measurement_noise_cov=SENSORS,
        prior_mean=[0.0, 0.0],
        prior_cov=[3.0, 0.5],
        states=[("angle", "theta", "rad", True), ("angular rate", "omega", "rad/s")],
        input_quantities=[("torque", "tau", "N m")],
        measurements=["cosine", "sine", ("measured rate", "rate", "rad/s")],
    )


# %%
# ``True`` marks the angle: it wraps, and errors are taken the short way round.
#
# The problem
# -----------
#
# The env is rolled out once per seed under a policy, here random torques, and the true state is recorded for
# comparison.


def true_state(env):
    return env.state


problem = EnvProblem(
    "Pendulum-v1",
    Steps(amplitude=2.0, hold=10),
    pendulum(),
    state_of=true_state,
    measurement_noise_cov=SENSORS,
    steps=120,
    name="pendulum",
)
study = tuning.tune(problem, filter="ekf", trials=TRIALS)
study

# %%

figure = study.plot_errors()

# %%
# With the env
# ------------
#
# ``make_env`` returns the env that the study ran. The agent now observes the estimate of angle and rate.

env = EstimateState(problem.make_env(), filter=study.filter)
observation, info = env.reset(seed=0)
for _ in range(20):
    observation, reward, terminated, truncated, info = env.step(
        env.action_space.sample()
    )
print(info["estimate"], info["estimate_cov"].diagonal())

# %%
# Other parts of a problem, and its use on the command line: :doc:`/problems`. How much a filter's estimate
# improves a policy: :doc:`policies`.
