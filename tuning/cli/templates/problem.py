"""A problem of your own: a plant that generates data, and what filters assume of it. Here: a mass on a spring.

Replace the code below by your own. To try it as it is:

thruster tune --problem template:problem --filter ekf --trials 50
thruster compare --problem template:problem --filter ekf --filter ukf --filter enkf
thruster filters --problem template:problem                     # which filters fit, and which do not
"""

from typing import NamedTuple

from filters import StateSpaceModel
from tuning.problems.model_problem import ModelProblem


class Constants(NamedTuple):
    """Constants of the functions below."""

    dt: float  # sample time [s]
    mass: float  # [kg]
    stiffness: float  # [N/m]
    damping: float  # [N s/m]


def move(x, u, c):
    """The next state: x the state, u the inputs that act over the step, c the constants.

    Filters compile this: use operators, `math` and tuples; no arrays, no objects. `math.sin` is fine.
    """
    position, speed = x
    acceleration = (u[0] - c.stiffness * position - c.damping * speed) / c.mass
    speed = speed + c.dt * acceleration
    return (position + c.dt * speed, speed)


def look(x, c):
    """The measurements of a state, without noise: here only the position."""
    return (x[0],)


def model(stiffness):
    """A mass on a spring of some stiffness [N/m]."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=Constants(dt=0.02, mass=1.0, stiffness=stiffness, damping=1.5),
        # Variances of the model error of each state. They are PER STEP and do not scale with dt.
        process_noise_cov=[1e-7, 4e-4],
        # Variance of each measurement: the square of the data sheet's standard deviation.
        measurement_noise_cov=[1e-4],
        # Knowledge before the first measurement: a mean, and the variance of each state.
        prior_mean=[0.0, 0.0],
        prior_cov=[0.01, 0.1],
        # Range of each state in normal operation. The rule of thumb, the start of tuning, uses 1 % of it for Q.
        state_low=[-0.2, -1.0],
        state_high=[0.2, 1.0],
        # Name, symbol and unit, for tables and pictures.
        states=[("position", "x", "m"), ("speed", "v", "m/s")],
        input_quantities=[("force", "F", "N")],
        measurements=[("measured position", "z", "m")],
    )


# States and measurements are drawn from the first model; filters assume the second, here with a spring that is too
# soft. With one model instead of two the filter knows the plant. "steps" are random levels of the input, each held
# for 25 steps; there are also prbs, multi-sine and dwells, or use an array of shape (steps, inputs).
problem = ModelProblem(
    model(stiffness=40.0),
    model(stiffness=36.0),
    inputs={"name": "steps", "amplitude": 4.0, "hold": 25},
    steps=300,
    dt=0.02,
    name="template",
    about="a mass on a spring that the filter assumes to be 10 % softer",
)
