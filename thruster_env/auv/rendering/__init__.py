"""Pictures of the vehicle on its way, 640 x 400 pixels: in a window (`human`) or as arrays (`rgb_array`).

Above, the last 500 steps of its path in three dimensions beside the path to follow, and its attitude seen from
port, from astern and from above; below, strip charts of depth and speed, and gauges of thrust and planes. An
estimate is blue, with its band of two standard deviations; a filter without a position shows in charts and
attitude only. The common parts of all plants' pictures, and how a filter shows its estimate, are in
`thruster_env.render`.
"""

from thruster_env.auv.rendering.renderer import Moment, Overlay, Renderer

__all__ = ["Moment", "Overlay", "Renderer"]
