"""The scale of a thruster's scenario: its bound or, where there is none, the error of the open loop."""

from __future__ import annotations

import numpy as np

from filters.baselines import OpenLoop
from filters.engine.batch import run
from thruster_env.core.checks import at_least
from thruster_env.thruster.linear.analysis import jacobians, steady_state
from thruster_env.thruster.model import model_of_plant
from thruster_env.thruster.plant import Plant
from tuning.thruster.scenario import Scenario

SEQUENCES = 1200  # voltage sequences for a stored scale
ROUNDING = 1e-6  # of the untuned noise: anything below is rounding
PARTS = (0.5, 1.0)  # of the largest voltage, where stability is checked: at rest the quadratic drag vanishes


def computed_scale(scenario: Scenario, sequences: int = SEQUENCES, truths: int = 100) -> np.ndarray:
    """The scale (2,) of a scenario, over voltage sequences of the seeds 0, 1, 2, ...

    It is `Scenario.bound`, and a score is then RMSE over the bound. Where there is no bound, because Q is
    singular, it is the RMSE of the open loop: a score below 1 then shows what the measurements contribute.

    Args:
        scenario: its own scale is not used.
        sequences: number of seeds.
        truths: number of true paths drawn for each seed, for the bound.

    Raises:
        ValueError: if there is neither a bound nor a stable open loop, or the scale is zero or not finite.
    """
    data = scenario.data(range(at_least("sequences", sequences, 1)))
    if scenario.has_bound:
        what, scale = "the bound", scenario.bound(data, truths)
    elif is_stable(scenario.plant):
        open_loop = OpenLoop(model=model_of_plant(scenario.plant))
        estimates = run(open_loop, data.filter_keys, data.inputs, data.measurements)
        errors = (estimates.means - data.states)[:, data.late]
        what, scale = "the RMSE of the open loop", np.sqrt((errors**2).mean(axis=(0, 1)))
    else:
        raise ValueError(
            "a scenario needs a bound or a stable open loop as the scale of errors, but Q is singular, "
            f"{list(scenario.process_noise_cov)}, and the open loop is unstable"
        )
    rounding = ROUNDING * np.sqrt(scenario.untuned["process_noise_cov"])
    if not (np.isfinite(scale).all() and (scale > rounding).all()):
        raise ValueError(f"scale must be positive in every state, but {what} is {scale.tolist()}")
    return scale


def is_stable(plant: Plant) -> bool:
    """Whether the plant without feedback is stable: all modes decay, ahead and astern."""
    if plant.linear is not None:
        matrices = [plant.linear.a]
    else:
        voltages = (sign * part * plant.max_voltage for sign in (1.0, -1.0) for part in PARTS)
        flow = plant.ambient_velocity
        matrices = [
            jacobians(plant.parameters, steady_state(plant.parameters, v, flow)[:2], v, flow)[0] for v in voltages
        ]
    return all(np.linalg.eigvals(a).real.max() < 0.0 for a in matrices)
