"""Pictures of the thruster at work, 640 x 400 pixels: in a window (`human`) or as arrays (`rgb_array`).

Above, the hull cut through at the thruster, with the propeller turning and arrows of the flow and of the push on
the ship; below, strip charts of the last 500 steps and gauges of thrust and voltage, with truth and measurement.
One step is one frame, so `render_fps = 1/dt` shows true speed.

The common parts of all plants' pictures, and how a filter shows its estimate, are in
`thruster_env.render`.

Needs pygame (the extra `render`), which is imported when a `Renderer` is made.
"""

from thruster_env.thruster.rendering.renderer import Moment, Overlay, Renderer

__all__ = ["Moment", "Overlay", "Renderer"]
