"""
Tune a filter, and measure the gain
===================================

A Kalman-type filter needs Q and R. Here a study finds them, and held-out seeds show the gain.
"""

# %%
# A scenario where it matters
# ---------------------------
#
# On ``outliers`` one measurement in twenty is off by some 10 N, which the filter's model does not include. A
# :term:`study` runs many trials on the same training seeds; trials that are worse on the same seeds are pruned.

import tempfile
from pathlib import Path

import gymnasium as gym

import thruster_env
import tuning
from filters import EstimateState

TRIALS = 40

study = tuning.tune("outliers", filter="ekf", trials=TRIALS, seed=0)
study

# %%
# The first baseline is the :term:`scaled default`: R from the sensor's data sheet, and one factor on Q
# for which the mean NIS (normalised innovation squared) is right. A careful engineer has it after five minutes.
# The :term:`oracle` has the plant's own Q and R. Neither helps here: no factor on Q helps with outliers in the
# sensor, and the plant's own R does not include them. The study makes R some twenty times the data sheet's.

figure = study.plot_errors()

# %%
# One held-out run, before and after, with the filter's 95 % band:

figure = study.plot_run()

# %%
# The course of the study: each point is a trial, the line is the best so far.

figure = study.plot_history()

# %%
# The trials are a table, too (pandas, ``pip install pandas``):

study.to_frame().tail(4).round(4)

# %%
# Use it
# ------
#
# ``study.filter`` is the tuned filter. The saved JSON works in an env, on a log, and with ``thruster
# verify``, which recomputes all held-out metrics.

print(study.filter.model.process_noise_cov, study.filter.model.measurement_noise_cov)

with tempfile.TemporaryDirectory() as folder:
    path = study.save(Path(folder) / "tuned.json")
    outliers = {"thrust": [{"name": "outliers", "std": 10.0, "probability": 0.05}]}
    env = EstimateState(gym.make("BowThruster-v0", sensors=outliers), tuned=path)
    observation, info = env.reset(seed=0)
    observation, *_ = env.step([12.0])
print(observation)

# %%
# **Covariances are per step and do not scale with dt**: the file contains its sample time, and any other is
# refused.
#
# ``tuning.report(study, "report.html")`` writes a page with all of this, for any browser. The study in detail, and
# where tuning gains little: :doc:`/tuning`.
