"""
First steps
===========

A thruster, a filter, and the uncertainty of the filter's estimate. Nothing is trained or tuned here.
"""

# %%
# The env
# -------
#
# The action is a voltage. The observation is the measured thrust. Motor speed and flow velocity are hidden:
# ``info["state"]`` contains them, for comparison.
#
# ``EstimateState`` runs a filter beside any such env, here an extended Kalman filter. The agent now observes the
# estimate of the two hidden states.

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

import thruster_env
from filters import EstimateState

STEPS = 500

env = EstimateState(gym.make("BowThruster-v0"), filter="ekf")
observation, info = env.reset(seed=1)
print("observed estimate", observation)
print("estimate         ", info["estimate"])
print("true state       ", info["state"])

# %%
# One episode
# -----------
#
# The voltage changes at random four times a second. In each step we keep the truth, the estimate, its covariance
# and the innovation, the measurement minus its prediction.

voltages = np.repeat(
    np.random.default_rng(0).uniform(-24.0, 24.0, STEPS // 25 + 1), 25
)[:STEPS]
truth, estimate, variance, innovation, innovation_variance = [], [], [], [], []
for voltage in voltages:
    _, _, _, _, info = env.step([voltage])
    truth.append(info["state"])
    estimate.append(info["estimate"])
    variance.append(info["estimate_cov"].diagonal())
    innovation.append(info["innovation"][0])
    innovation_variance.append(info["innovation_cov"][0, 0])
truth, estimate, deviation = np.array(truth), np.array(estimate), np.sqrt(variance)

# %%
# Is the covariance right?
# ------------------------
#
# A filter's covariance is a claim about its errors: about 95 % of them should lie within 1.96 standard
# deviations. The thrust contains little information on motor speed, yet the band is right.

time = 0.01 * np.arange(1, STEPS + 1)
figure, axes = plt.subplots(2, 2, figsize=(9, 4.6), layout="constrained", sharex=True)
for column, name in enumerate(("motor speed [rad/s]", "flow velocity [m/s]")):
    axes[0, column].plot(time, truth[:, column], "k", linewidth=2.5, label="truth")
    axes[0, column].plot(
        time, estimate[:, column], "tab:orange", linewidth=1, label="estimate"
    )
    axes[0, column].set_title(name)
    band = 1.96 * deviation[:, column]
    axes[1, column].fill_between(
        time, -band, band, color="tab:blue", alpha=0.25, linewidth=0, label="95 % band"
    )
    axes[1, column].plot(
        time,
        estimate[:, column] - truth[:, column],
        color="tab:red",
        linewidth=0.8,
        label="error",
    )
    axes[1, column].set_xlabel("time [s]")
axes[0, 0].legend()
axes[1, 0].legend()

inside = np.mean(np.abs(estimate - truth) < 1.96 * deviation, axis=0)
print(f"inside the band: motor speed {inside[0]:.0%}, flow velocity {inside[1]:.0%}")

# %%
# Without a true state the innovations show this. The NIS (normalised innovation squared) is the innovation over
# its standard deviation, squared; its mean is 1 for a filter that is :term:`consistent`.

nis = np.square(innovation) / innovation_variance
print(f"mean NIS: {nis.mean():.2f}")

# %%
# The same filter without an env
# ------------------------------
#
# Filters are values. ``init``, ``predict`` and ``update`` are pure functions of a belief, and a model is all
# they need.

from filters import make_filter
from thruster_env.thruster.model import thruster_model

ekf = make_filter("ekf", thruster_model(preset="tunnel"))
belief = ekf.predict(ekf.init(), u=[12.0])
belief, innovation = ekf.update(belief, z=[8.1])
print(belief.mean, np.sqrt(belief.cov.diagonal()))

# %%
# **Covariances are per step and do not scale with dt.** The model above is for steps of 10 ms; with another
# ``dt`` it needs another Q (:doc:`/howto/sample_time`).
#
# Next: :doc:`choose_a_filter`.
