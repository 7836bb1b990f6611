"""Layout: rows of the memory of many thrusters, and offsets in the packed parameters of compiled code."""

from __future__ import annotations

from thruster_env.core.memory import FRONT
from thruster_env.thruster.channels import MAX_CHANNELS
from thruster_env.thruster.dynamics import Constants

# Behind the rows that all plants have in front, those that every step reports, ...
OMEGA, FLOW, THRUST, AMBIENT, REFERENCE, NEXT_REFERENCE = range(len(FRONT), len(FRONT) + 6)
READINGS = NEXT_REFERENCE + 1  # a row for each channel, ...
VALID = READINGS + MAX_CHANNELS  # ... and whether it is valid
REPORTED = VALID + MAX_CHANNELS  # where they end
# ... and those that it keeps to itself. Rows of disturbances, then of drawn constants, follow.
COMMAND, LAST_COMMAND, VOLTAGE = range(REPORTED, REPORTED + 3)
FIXED_ROWS = REPORTED + 3

CONSTANT_COUNT = len(Constants._fields)

# Places in the row of numbers; the constants of the equations of motion come first.
SUBSTEPS, TOP_VOLTAGE, SAMPLE_TIME, CONSTANT_ROWS, LINEAR = range(CONSTANT_COUNT, CONSTANT_COUNT + 5)
Q_ROOT = LINEAR + 1  # lower triangle of 2 x 2, by rows
PRIOR_MEAN, PRIOR_ROOT = Q_ROOT + 3, Q_ROOT + 5
CHANNEL_COUNT = PRIOR_ROOT + 3
CHANNEL_CODES = CHANNEL_COUNT + 1
R_ROOT = CHANNEL_CODES + MAX_CHANNELS  # 4 x 4 by rows
LINEAR_MODEL = R_ROOT + MAX_CHANNELS * MAX_CHANNELS  # A_d (2, 2), B_d (2, 2), C (2,) by rows
REWARD_WEIGHTS = LINEAR_MODEL + 10  # tracking, energy, voltage rate
THRUST_SCALE = REWARD_WEIGHTS + 3
LIMITS = THRUST_SCALE + 1  # of |omega_m| and |U_a|
SECTIONS = LIMITS + 2  # number of effects on amplifier, flow, sensors and reference
FIRST_EFFECT = SECTIONS + 4
