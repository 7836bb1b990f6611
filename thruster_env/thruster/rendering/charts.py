"""The thruster's strip charts: thrust, motor speed and flow."""

from __future__ import annotations

from thruster_env.render.canvas import Canvas
from thruster_env.render.charts import Charts, Strip

TOP = 186  # of the lower half of the picture [px]


def thruster_charts(
    canvas: Canvas, *, dt: float, thrust_scale: float, speed_scale: float, flow_scale: float
) -> Charts:
    """Three strip charts; dt is in s, scales are in N, rad/s and m/s. Thrust has a gauge besides."""
    strips = (
        Strip("thrust", "thrust [N]", 1, 207, 66, thrust_scale, "measured_thrust", "reference", False),
        Strip("omega_m", "motor speed [rad/s]", 1, 292, 38, speed_scale),
        Strip("U_a", "flow [m/s]", 2, 349, 34, flow_scale),
    )
    return Charts(canvas, strips, top=TOP, dt=dt)
