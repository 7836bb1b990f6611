"""
Tune a filter, and show what it is worth
========================================

Q and R are what a Kalman-type filter has to be told. Here a study finds them, and seeds that the study never saw
show whether that was worth it.
"""

# %%
# A scenario where it matters
# ---------------------------
#
# On ``outliers`` one measurement in twenty is off by some 10 N, and the filter's model knows nothing of that. A
# :term:`study` runs many proposals on the same training seeds; proposals that are worse on the very same seeds
# end early.

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
# The baseline to look at first is the :term:`scaled default`: R from the sensor's data sheet, and one factor on
# Q by which the mean NIS (normalised innovation squared) is right. A careful engineer has that after five
# minutes. The :term:`oracle` knows the plant's own Q and R. Neither helps here: the outliers are in the sensor,
# where no factor on Q can find them, and the plant's own R does not count them. The study makes R some twenty
# times the data sheet's.

figure = study.plot_errors()

# %%
# One held-out run, before and after, with the band of 95 % in which the filter believes:

figure = study.plot_run()

# %%
# How the study went: each point is a trial, the line is the best so far.

figure = study.plot_history()

# %%
# The trials are a table, too (pandas, ``pip install pandas``):

study.to_frame().tail(4).round(4)

# %%
# Use it
# ------
#
# ``study.filter`` is the tuned filter. Saved as JSON it goes into an env, over a log, or to ``thruster verify``,
# which computes all held-out metrics once more.

print(study.filter.model.process_noise_cov, study.filter.model.measurement_noise_cov)

with tempfile.TemporaryDirectory() as folder:
    path = study.save(Path(folder) / "tuned.json")
    outliers = {"thrust": [{"name": "outliers", "std": 10.0, "probability": 0.05}]}
    env = EstimateState(gym.make("BowThruster-v0", sensors=outliers), tuned=path)
    observation, info = env.reset(seed=0)
    observation, *_ = env.step([12.0])
print(observation)

# %%
# **Covariances are per step and do not scale with dt**: the file says for which sample time it is, and another
# one is refused.
#
# ``tuning.report(study, "report.html")`` writes a page with all of this, which any browser shows. What a study
# does in detail, and where tuning is worth little: :doc:`/tuning`.
