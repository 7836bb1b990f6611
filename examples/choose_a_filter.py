"""
Choose a filter
===============

Which of two dozen filters, for which plant? All see the same runs, and only paired differences on the same
seeds count.
"""

# %%
# Side by side
# ------------
#
# A scenario is a plant with its inputs, sensors and disturbances. On ``nominal`` the model is right and the noise
# is Gaussian. Each filter knows the plant's own Q and R here, so that the comparison is between filters and not
# between tunings.

import tuning
from filters import FILTERS, make_filter
from thruster_env.thruster.model import thruster_model

SEEDS = 50

print(len(FILTERS), "filters")
tuning.compare(["ekf", "kf", "ukf", "enkf", "pf", "open-loop"], "nominal", seeds=SEEDS)

# %%
# The :term:`score` is the mean over states of RMSE over the bound, with its 95 % interval: a filter at the bound
# has 1. NEES (normalised estimation error squared) should be the number of states, here 2, and NIS (normalised
# innovation squared) is given over the number of measurements, so that 1 is right. The verdict is
# :term:`paired`, against the first filter.
#
# The Kalman filter is linearised at one operating point, and diverges as soon as the voltage leaves it. The
# extended Kalman filter is at the bound, which no filter can beat. Particle filters reach it, too, at several
# hundred times the cost.
#
# Where it matters
# ----------------
#
# With outliers in the sensor the ranking changes. No filter's model includes them; ``ekf-robust`` gives unlikely
# measurements less weight. All have the plant's own Q and R here (``knows="true"``).

comparison = tuning.compare(
    ["ekf", "ekf-robust", "enkf", "pf"], "outliers", seeds=SEEDS, knows="true"
)
comparison

# %%

figure = comparison.plot_scores()

# %%
# Further parameters
# ------------------
#
# Besides the model every filter has its own parameters. ``thruster filters enkf`` and ``help`` print them with the
# filter's equations.

enkf = make_filter("enkf", thruster_model(), ensemble_size=50, inflation=1.02)
print(enkf.ensemble_size, enkf.init().members.shape)

# %%
# Reasons to choose a filter, with pictures of where each works and fails: :doc:`/filters`. All scenarios with all
# filters: :doc:`/ranking`. Next: :doc:`tune`.
