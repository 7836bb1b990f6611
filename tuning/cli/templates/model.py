"""A model of your own: motion, measurements, and their uncertainty. Here: a mass on a spring.

Replace the code below by your own. To try it as it is:

python template.py                                        # writes template.csv, a log to try these with
thruster estimate template.csv --model template:model --filter ekf --plot estimate.png
thruster tune --log template.csv --model template:model --filter ekf --trials 30
thruster identify template.csv --model template:model --free stiffness,damping --out values.toml
"""

from typing import NamedTuple

from filters import StateSpaceModel


class Constants(NamedTuple):
    """Constants of the functions below; `thruster identify --free NAME` finds them."""

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


def model(dt=0.02, mass=1.0, stiffness=40.0, damping=1.5):
    """The model. Commands on logs call it with the log's `dt`; the other arguments can be identified."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=Constants(dt, mass, stiffness, damping),
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
        # Name, symbol and unit, for tables, pictures and the columns of logs.
        states=[("position", "x", "m"), ("speed", "v", "m/s")],
        input_quantities=[("force", "F", "N")],
        measurements=[("measured position", "z", "m")],
    )


if __name__ == "__main__":  # a log to try it with: 60 s under a force that changes its sign
    import numpy as np

    from thruster_env.core.streams import episode_keys
    from thruster_env.logs.write import write_columns
    from thruster_env.model import simulate

    truth, dt, steps = model(), 0.02, 3000
    force = 4.0 * np.sign(np.sin(2.0 * np.arange(steps) * dt))
    run = simulate.simulate(truth, episode_keys([1]), force.reshape(1, steps, 1))
    write_columns(
        "template.csv",
        {"t_s": dt * np.arange(steps + 1), "F_N": np.append(force, np.nan), "z_m": run.measurements[0, :, 0]},
    )
