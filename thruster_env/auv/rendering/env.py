"""How a vehicle env draws itself."""

from __future__ import annotations

from typing import Any

from thruster_env.auv.engine import memory as at
from thruster_env.auv.rendering.history import Moment
from thruster_env.auv.rendering.renderer import MODES, Renderer
from thruster_env.core.memory import TIME
from thruster_env.env.rendered import RenderedEnv


class RenderedVehicle(RenderedEnv):
    """An env with a vehicle as `plant` and a path in its `task`."""

    task: Any
    metadata: dict[str, Any] = {"render_modes": list(MODES), "render_fps": 20}

    def make_renderer(self) -> Renderer:
        """What draws the vehicle on its way."""
        assert self.render_mode is not None  # a renderer is made for a mode only
        return Renderer(
            self.render_mode,
            path=self.task.path.points,
            max_thrust=self.plant.max_thrust,
            max_plane=self.plant.max_plane,
            dt=self.plant.dt,
            frames_per_second=self.metadata["render_fps"],
            size=self.render_size,
        )

    def moment_of(self, report: list[float]) -> Moment:
        """What the renderer adds of a report: truth, measurements, the path abreast, and what acts."""
        channels, state = self.plant.channels, report[at.STATE : at.STATE + at.N]

        def measured(symbol: str) -> float | None:
            return report[at.READINGS + channels.index(symbol)] if symbol in channels else None

        return Moment(
            time=report[TIME],
            x=state[at.X],
            y=state[at.Y],
            depth=state[at.Z],
            phi=state[at.PHI],
            theta=state[at.THETA],
            psi=state[at.PSI],
            u=state[at.U],
            measured_depth=measured("z"),
            measured_u=measured("u"),
            reference_depth=state[at.Z] - report[at.TRUE_ERRORS + 1],
            reference_u=self.task.speed,
            thrust=report[at.INPUTS],
            stern=report[at.INPUTS + 2],
            rudder=report[at.INPUTS + 3],
        )
