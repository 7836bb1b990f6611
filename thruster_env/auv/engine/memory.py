"""Where things lie: rows of the memory of many vehicles, and places in the row of numbers of compiled code."""

from __future__ import annotations

from thruster_env.auv.channels import MAX_CHANNELS
from thruster_env.auv.forces import Constants
from thruster_env.auv.noise import BLOCK
from thruster_env.auv.quantities import STATES
from thruster_env.core.memory import FRONT

N = len(STATES)
U, V, W, P, Q, R, PHI, THETA, PSI, X, Y, Z = range(N)  # places in a state

# Behind the rows that all plants have in front, those that every step reports: the state, ...
STATE = len(FRONT)
CURRENT = STATE + N  # north, east, down [m/s]
INPUTS = CURRENT + 3  # X_prop, K_prop, delta_s, delta_r that act
TRUE_ERRORS = INPUTS + 4  # cross-track and vertical [m], which the reward is made of
PATH_DEPTH = TRUE_ERRORS + 2  # abreast of where the vehicle takes itself to be, in the next step [m]
ERRORS = PATH_DEPTH + 1  # by the vehicle's own reckoning: cross-track, vertical, course (sin, cos), speed
RECKONED = ERRORS + 5  # north, east, down, yaw by its own reckoning
PIECE = RECKONED + 4  # of the path that the true position has got to
OFFSET = PIECE + 1  # of the path's depth in the next step [m]
READINGS = OFFSET + 1  # a row for each channel, ...
VALID = READINGS + MAX_CHANNELS  # ... and whether it is valid
REPORTED = VALID + MAX_CHANNELS  # where they end
# ... and those that it keeps to itself. Rows of disturbances follow.
COMMAND = REPORTED  # as the action has them
RECKONED_PIECE = COMMAND + 4
GROUND_SPEED = RECKONED_PIECE + 1  # north, east, down by its own reckoning in the last step [m/s]
SCRATCH = GROUND_SPEED + 3  # draws of noise
FIXED_ROWS = SCRATCH + -(-max(N, MAX_CHANNELS) // BLOCK) * BLOCK

CONSTANT_COUNT = len(Constants._fields)

# Places in the row of numbers; the constants of the equations of motion come first.
SUBSTEPS, SAMPLE_TIME, INPUT_COUNT, MAX_THRUST, MAX_TORQUE, MAX_PLANE = range(CONSTANT_COUNT, CONSTANT_COUNT + 6)
TORQUE_RATIO, PROPELLER_DECAY, PLANE_DECAY = range(MAX_PLANE + 1, MAX_PLANE + 4)
MEAN = PLANE_DECAY + 1
PRIOR_ROOT = MEAN + N  # (12, 12) by rows
Q_ROOT = PRIOR_ROOT + N * N
CHANNEL_COUNT = Q_ROOT + N * N
CHANNEL_CODES = CHANNEL_COUNT + 1
R_ROOT = CHANNEL_CODES + MAX_CHANNELS  # (m, m) by rows
MEASURED_IN = R_ROOT + MAX_CHANNELS * MAX_CHANNELS  # the row of each state's channel, 0 for none
WEIGHTS = MEASURED_IN + N  # cross-track, vertical, speed, planes
SPEED = WEIGHTS + 4  # to keep [m/s]
STEP_SIZE, HOLD_STEPS = SPEED + 1, SPEED + 2  # of the depth [m], and for so many steps
STEEPEST = HOLD_STEPS + 1  # pitch [rad] at which an episode ends
SECTIONS = STEEPEST + 1  # number of effects on current and sensors
FIRST_EFFECT = SECTIONS + 2  # the place where they begin
PIECES = FIRST_EFFECT + 1  # of the path: their number, then each
FIRST_PIECE = PIECES + 1
