"""The other envs: a path to follow, and steps of the depth."""

from __future__ import annotations

from collections.abc import Sequence

from thruster_env.auv.env import SegorogeniAUVEnv
from thruster_env.auv.plant import make_plant
from thruster_env.auv.task import make_depth_task, make_task
from thruster_env.core.arguments import arguments_of, takes_arguments_of


class SegorogeniAUVPathEnv(SegorogeniAUVEnv):
    """An autonomous underwater vehicle: follow a path in three dimensions at a speed.

    As `SegorogeniAUVEnv`, except for these:

    ## Observation space
    Channels and validity flags, then the path:

    | num | observation | min | max | unit |
    |---|---|---|---|---|
    | -6 | depth of the path abreast of the vehicle | -inf | inf | m |
    | -5 | distance to starboard of the path | -inf | inf | m |
    | -4 | distance below the path | -inf | inf | m |
    | -3 | sine of yaw less the path's course | -inf | inf | - |
    | -2 | its cosine | -inf | inf | - |
    | -1 | u less the speed to keep | -inf | inf | m/s |

    These compare the path with what the vehicle itself can know, never with the true state: yaw, depth and speed
    as measured, with noise, and a position by dead reckoning from measured velocities and attitude, from the known
    start. So they drift as the vehicle's own navigation does, by decimetres in half a minute with the default
    sensors, and more with others. `info["path_errors"]` and the reward have the true ones. Where a filter's
    estimate is in the observation, `control.depth_and_course` compares that with the path in their place, and with
    the depth.

    ## Reward
    Errors are measured to the point of the path abreast of the vehicle, so the time does not matter; the speed has
    its own term.

    ## Arguments
    `path` is "IV" by default; see `thruster_env.auv.task.make_task`. Episodes are truncated after 600 steps (30
    s).
    """

    observes_errors = True

    @takes_arguments_of(make_plant, make_task, leaving_out=["substeps"], defaults={"path": "IV"})
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        self._build(arguments, make_task(**arguments_of(make_task, arguments)), (render_mode, render_size))


class SegorogeniAUVDepthEnv(SegorogeniAUVEnv):
    """An autonomous underwater vehicle: follow steps of the depth up and down, on a straight course north.

    As `SegorogeniAUVPathEnv`, whose observation it has; the path's depth steps by `step_size` (2 m) up or down
    at random every `hold_time` (15 s), within twice of that about `depth` (6 m), where the vehicle starts.
    Observation k compares with the depth of time k + 1, the one that the reward of the next step compares with.
    Episodes are truncated after 1200 steps (60 s).

    ## Arguments
    The list is that of `thruster_env.auv.plant.make_plant` and of `thruster_env.auv.task.make_depth_task`;
    `render_mode` and `render_size` come on top.
    """

    observes_errors = True

    @takes_arguments_of(make_plant, make_depth_task, leaving_out=["substeps"])
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        self._build(
            arguments, make_depth_task(**arguments_of(make_depth_task, arguments)), (render_mode, render_size)
        )
