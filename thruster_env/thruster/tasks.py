"""The other envs: tracking, reversal, and the published linear systems."""

from __future__ import annotations

from collections.abc import Sequence

from thruster_env.core.arguments import arguments_of, takes_arguments_of
from thruster_env.thruster.env import BowThrusterEnv
from thruster_env.thruster.linear.linear_plant import PUBLISHED_NOISE, make_linear_plant
from thruster_env.thruster.task import make_task


class BowThrusterTrackingEnv(BowThrusterEnv):
    """A ship's bow thruster: follow a reference thrust that changes, ahead.

    As `BowThrusterEnv`, except for these:

    ## Observation space
    | num | observation | min | max | unit |
    |---|---|---|---|---|
    | 0 | measured thrust T + v at time k | -inf | inf | N |
    | 1 | reference r at time k + 1 | -inf | inf | N |

    With other `sensors`, their channels and validity flags come first, the reference last.

    ## Reward
    That of step k compares T with r of time k + 1, the one that the action saw.

    ## Arguments `reference` is a list of signals of `effects.reference.REFERENCE_SIGNALS`, which are added, each a
    mapping with its `name` ("constant", "steps", "ramps", "prbs", "multi-sine", "band-limited-noise", "recorded");
    levels are fractions of the steady thrust at max_voltage. By default steps between 0.1 and 0.8, held for 1 s.
    """

    observes_reference = True
    default_reference = ({"name": "steps", "low": 0.1, "high": 0.8, "hold_time": 1.0},)

    def _reference_signals(self, reference):
        return self.default_reference if reference is None else reference


class BowThrusterReversalEnv(BowThrusterTrackingEnv):
    """A ship's bow thruster: follow a reference thrust that crosses zero, ahead and astern.

    As `BowThrusterTrackingEnv`; by default the reference runs in straight lines of 1 s between levels drawn from
    -0.6 to 0.6 of the steady thrust at max_voltage. Near zero the thrust contains hardly any information on the
    state.
    """

    default_reference = ({"name": "ramps", "low": -0.6, "high": 0.6, "hold_time": 1.0},)


class BowThrusterLinearEnv(BowThrusterEnv):
    """A linear system that Kiki (2020) and Nurhadi et al. (2022) print in place of the bow thruster.

        x_{k+1} = A_d x_k + B_d (V_s, U_0)_k + w_k,    z_k = C x_k + v_k

    Here the Kalman filter is optimal. Observation, action, reward, info and episode are those of `BowThrusterEnv`;
    T_max and the range of the state are those of the equilibrium at max_voltage. (The open-bladed system is
    unstable.)

    ## Arguments
    The list is that of `thruster_env.thruster.linear.linear_plant.make_linear_plant` (`system` is "tunnel" or
    "open_bladed"; `process_noise_cov` and `measurement_noise_cov` are the published 0.5 of each state and
    measurement by default) and of `thruster_env.thruster.task.make_task`; `render_mode` and `render_size` come on
    top.
    """

    @takes_arguments_of(
        make_linear_plant, make_task, defaults={"process_noise_cov": (PUBLISHED_NOISE, PUBLISHED_NOISE)}
    )
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        plant = make_linear_plant(**arguments_of(make_linear_plant, arguments))
        self._build(plant, (render_mode, render_size), arguments)
