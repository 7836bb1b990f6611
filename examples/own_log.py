"""
Tutorial: a log of your own
===========================

Inputs and measurements in a table, no true state: how to read it, find the model's parameters, tune Q and R from
the innovations, and estimate the hidden state.
"""

# %%
# The log
# -------
#
# A CSV or Parquet file, a pandas table or a mapping from headers to arrays. Row k contains the measurements at
# time k dt and the input that acts from then on; headers name quantities and units. Here there are four runs of a
# thruster whose voltage gain is a tenth below its data sheet's. Motor speed and flow velocity are not in the
# table.

import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np

import tuning
from thruster_env import PRESETS

TRIALS = 30
ROWS = 1000

TRUE_GAIN = 0.9 * PRESETS["tunnel_physical"].voltage_gain
WORN = PRESETS["tunnel_physical"]._replace(voltage_gain=TRUE_GAIN)


def record(seed):
    """A run, as a data logger records it."""
    env = gym.make("BowThruster-v0", preset=WORN, max_episode_steps=ROWS).unwrapped
    levels = np.random.default_rng(seed).uniform(-20.0, 20.0, ROWS // 50 + 1)
    voltages = np.repeat(levels, 50)[:ROWS]
    observation, _ = env.reset(seed=seed)
    thrusts = [observation[0]]
    for voltage in voltages[:-1]:
        observation, *_ = env.step([voltage])
        thrusts.append(observation[0])
    return {
        "time_s": 0.01 * np.arange(ROWS),
        "voltage_V": voltages,
        "measured_thrust_N": np.array(thrusts),
    }


runs = [record(seed) for seed in range(4)]
for header, column in runs[0].items():
    print(header, column[:3])

# %%
# Errors of the data sheet
# ------------------------
#
# A first estimate, with the data sheet's model: the mean NIS (normalised innovation squared) is above its band, so
# the innovations are larger than the filter assumes.

before = tuning.estimate(("tunnel_physical", runs[3]))
before

# %%
# ``identify`` finds the maximum-likelihood parameters with standard errors, and reports which of them the runs do
# not determine.

identified = tuning.identify(("tunnel_physical", runs[:3]), ["voltage_gain"])
print(f"true voltage gain {TRUE_GAIN:.4g}")
identified

# %%
# Q and R
# -------
#
# For an EKF, use the Q and R of ``identify``; ``mine`` below contains them. A study is for other filters, other
# criteria, or logs with true states. This one uses the EKF, because it is the fastest filter.
#
# Without a true state the study maximises the likelihood of the innovations over Q and R, with their NIS
# kept in its band, and evaluates the result on other runs: every third run is :term:`held-out`.

mine = identified.save(Path(tempfile.mkdtemp()) / "mine.toml")
study = tuning.tune((mine, runs[:3]), filter="ekf", trials=TRIALS)
study

# %%
# The result is near the Q = diag(1, 4e-4) and R = 0.25 that generated the runs. The :term:`scaled default` ties
# with it here, because identification has found R already; the :term:`rule of thumb` is far behind.
#
# **Covariances are per step and do not scale with dt**: the result is for the log's sample time.
#
# Estimate
# --------
#
# The tuned filter on a new run. Its innovations agree with their predicted covariance.

after = tuning.estimate((mine, runs[3]), study)
after

# %%

figure = after.plot_states()

# %%
# The same with files, from the command line: ``thruster identify``, ``thruster tune --log`` and ``thruster
# estimate``. The format in full, irregular times, other units, clock offsets: :doc:`/logs`. On recordings of a
# real thruster: :doc:`/real_data`.
