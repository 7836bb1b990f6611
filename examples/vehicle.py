"""
The underwater vehicle
======================

The same filters and wrappers on a plant of six degrees of freedom: an autonomous underwater vehicle with a
Doppler log, gyros, a depth sensor and a compass.
"""

# %%
# A filter of twelve states
# -------------------------
#
# Only the name of the env changes. The filter's model comes from the env, with names and units.

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

import thruster_env.auv
from filters import EstimateState
from thruster_env.auv.paths import DepthAndCourse

STEPS = 600

env = EstimateState(gym.make("SegorogeniAUVPath-v0", path="IV"), filter="ekf")
observation, info = env.reset(seed=3)
states = env.filter.model.states
print(", ".join(f"{quantity.name} [{quantity.unit}]" for quantity in states))

# %%
# Along a path, on the estimate
# -----------------------------
#
# ``DepthAndCourse`` steers along a line of sight with PD on pitch and course. It uses the filter's estimate. The
# sensors have different rates, so some measurements are missing in most steps; the filter handles them.

controller, memory = DepthAndCourse.for_env(env, seen="navigation"), None
truth, estimate, deviation, distances = [], [], [], []
for _ in range(STEPS):
    action, memory = controller.predict(observation, memory)
    observation, reward, terminated, truncated, info = env.step(action)
    truth.append(info["state"])
    estimate.append(info["estimate"])
    deviation.append(np.sqrt(info["estimate_cov"].diagonal()))
    distances.append(info["path_errors"])
    if terminated or truncated:
        break
truth, estimate, deviation = np.array(truth), np.array(estimate), np.array(deviation)
across, below = np.sqrt(np.mean(np.square(distances), axis=0))
print(
    f"{len(truth)} steps; distance from the path {across:.2f} m across, {below:.2f} m in depth (RMS)"
)

# %%
# What is not observable
# ----------------------
#
# Depth is measured, horizontal position is not: its error is a random walk, and the band grows accordingly.

time = 0.05 * np.arange(1, len(truth) + 1)
figure, axes = plt.subplots(1, 3, figsize=(10, 3), layout="constrained")
for axis, i in zip(axes, (6, 9, 11), strict=True):
    band = 1.96 * deviation[:, i]
    axis.fill_between(
        time, -band, band, color="tab:blue", alpha=0.25, linewidth=0, label="95 % band"
    )
    axis.plot(
        time,
        estimate[:, i] - truth[:, i],
        color="tab:red",
        linewidth=0.8,
        label="error",
    )
    axis.set(title=f"{states[i].name} [{states[i].unit}]", xlabel="time [s]")
axes[0].legend()

# %%
# Equations, instruments, scenarios, the published comparisons: :doc:`/auv`. ``thruster compare --scenario
# auv:navigation`` ranks filters on it, and ``thruster train --task depth`` learns a policy.
