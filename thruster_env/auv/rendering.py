"""Pictures of the vehicle on its way, 640 x 400 pixels: in a window (`human`) or as arrays (`rgb_array`).

Above, the last 500 steps of its path in three dimensions beside the path to follow, and its attitude seen from
port, from astern and from above; below, strip charts of depth and speed, and gauges of thrust and planes. An
estimate is blue, with its band of two standard deviations; a filter without a position shows in charts and
attitude only. The common parts of all plants' pictures, and how a filter shows its estimate, are in
`thruster_env.render`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thruster_env.render.canvas import (
    BAND,
    ESTIMATE,
    FAINT,
    INK,
    PANEL,
    REFERENCE,
    SIGMAS,
    SIZE,
    SOFT_INK,
    WHITE,
    Axis,
    Canvas,
    Charts,
    Strip,
    draw_gauge,
    draw_gauge_frames,
    newest,
    number,
    round_up,
    runs,
)
from thruster_env.render.renderer import PlantRenderer


class ChartEntry(NamedTuple):
    """The truth at the end of a step, one entry of the strip charts."""

    time: float  # since the start of the episode [s]
    x: float  # north [m]
    y: float  # east [m]
    depth: float  # [m]
    phi: float  # [rad]
    theta: float  # [rad]
    psi: float  # [rad]
    u: float  # [m/s]
    measured_depth: float | None  # None where the sensors have none
    measured_u: float | None
    reference_depth: float  # of the path abreast [m]
    reference_u: float  # [m/s]
    thrust: float  # [N]
    stern: float  # [rad]
    rudder: float  # [rad]


class Overlay(NamedTuple):
    """A filter's estimate of a moment; None for states that it does not estimate."""

    label: str  # name of the filter in the legend
    x: float | None = None  # [m]
    x_std: float | None = None
    y: float | None = None
    y_std: float | None = None
    depth: float | None = None
    depth_std: float | None = None
    phi: float | None = None  # [rad]
    theta: float | None = None
    psi: float | None = None
    u: float | None = None  # [m/s]
    u_std: float | None = None


BOTTOM_OF_VIEW = 230  # where the lower part of the picture begins [px]


class Renderer(PlantRenderer):
    """Draws an episode: `begin` it, `add` every moment from the reset's on, `draw` where a frame is wanted.

    Its arguments, beside those of `PlantRenderer`, are path, points (K, 3) of the path to follow, north, east,
    down [m]; max_thrust, full scale of the thrust's gauge [N]; and max_plane, that of the planes' gauges [rad].
    """

    caption = "Underwater vehicle"
    moment, overlay = ChartEntry, Overlay
    positive = ("max_thrust",)

    def _make_pictures(self) -> None:
        canvas, arguments, top = self._canvas, self.arguments, BOTTOM_OF_VIEW
        strips = (
            Strip("depth", "depth [m]", 2, 254, 54, 100.0, *_named("depth"), says_numbers=False, downward=True),
            Strip("u", "speed ahead [m/s]", 2, 330, 52, 1.0, *_named("u")),
        )
        self._view = View(canvas, arguments["path"])
        self._dials = Dials(canvas, top)
        self._charts = Charts(canvas, strips, top=top, dt=arguments["dt"])
        self._gauges = Gauges(canvas, arguments["max_thrust"], arguments["max_plane"])

    def _draw(self, columns: dict[str, np.ndarray], count: int, label: str) -> None:
        path = self.arguments["path"]
        moment = ChartEntry(*(float(columns[name][-1]) for name in ChartEntry._fields))
        offset = moment.reference_depth - float(path[0, 2]) if len(path) == 2 else 0.0
        self._view.draw(columns, moment, offset)
        self._dials.draw(columns, moment)
        self._charts.draw(columns, count - 1, label)
        self._gauges.draw(moment)


def _named(name: str) -> tuple[str, str]:
    """Columns of a quantity's measurement and reference."""
    return f"measured_{name}", f"reference_{name}"


# The path in three dimensions: one looks north-east and down, at a box of water with a grid on its bottom.
#
# North runs to the upper right, east to the lower right. The grid lies below everything shown; a plumb line and
# shadows on it show the depth. The box grows by round steps as the vehicle leaves it.


WIDTH, HEIGHT = 498, 230  # [px]
MARGIN = 30  # [px]
AZIMUTH, ELEVATION = math.radians(40.0), math.radians(28.0)
LEAST_SIZE = 6.0  # of what is shown [m]
LENGTH = 34.0  # of the vehicle in the picture [px]; it is not to scale
WATER, BOTTOM, GRID = (226, 239, 246), (204, 224, 235), (176, 203, 218)
SHADOW, HULL, FIN = (150, 182, 200), (250, 180, 40), (120, 70, 20)
DASH = 4  # points of the path to follow in a dash
# The hull, nose first: places along it and radii, in lengths.
OUTLINE = np.array(
    [(0.5, 0.0), (0.47, 0.05), (0.4, 0.085), (0.2, 0.1), (-0.15, 0.1), (-0.38, 0.06), (-0.5, 0.012)]
)
FIN_PLACE, FIN_SPAN = -0.42, 0.17

_RIGHT = np.array([math.sin(AZIMUTH), math.cos(AZIMUTH), 0.0])
_DOWN = np.array(
    [-math.cos(AZIMUTH) * math.sin(ELEVATION), math.sin(AZIMUTH) * math.sin(ELEVATION), math.cos(ELEVATION)]
)
PROJECTION = np.stack([_RIGHT, _DOWN], axis=-1)  # (3, 2): from north, east, down to right and down


class View:
    """Path, vehicle and belief."""

    def __init__(self, canvas: Canvas, path: np.ndarray):
        """Take the points (K, 3) of the path to follow [m]."""
        self._canvas, self._path = canvas, path
        canvas.box(0, 0, WIDTH, HEIGHT, WATER)

    def draw(self, columns: dict[str, np.ndarray], moment: ChartEntry, offset: float) -> None:
        """Draw the newest moment; the path to follow is `offset` [m] deeper than its points."""
        trail = _points(columns, "")
        visited = trail[np.isfinite(trail).all(axis=1)]
        position = visited[-1] if len(visited) else np.zeros(3)
        path = _part_in_view(self._path, visited) + [0.0, 0.0, offset]
        corners = np.concatenate([visited, path, [position]])
        low, high = corners.min(axis=0), corners.max(axis=0)
        floor = high[2] + 0.12 * max(LEAST_SIZE, float((high - low).max()))
        self._fit(np.concatenate([corners, corners * [1.0, 1.0, 0.0] + [0.0, 0.0, floor]]))
        canvas = self._canvas
        canvas.clip(0, 0, WIDTH, HEIGHT)
        self._draw_grid(low, high, floor)
        for run in _runs(trail):
            canvas.lines(self._on_bottom(run, floor), SHADOW, 1.5)
        for k in range(0, len(path) - 1, 2 * DASH):
            canvas.lines(self._at(path[k : k + DASH + 1]), REFERENCE, 1.5)
        self._draw_band(columns, position)
        for run in _runs(_points(columns, "estimated_")):
            canvas.lines(self._at(run), ESTIMATE, 3)
        for run in _runs(trail):
            canvas.lines(self._at(run), INK, 1.25)
        canvas.lines([self._at(position), self._on_bottom(position, floor)], SOFT_INK, 0.75)
        canvas.dots([self._on_bottom(position, floor)], 2.0, SHADOW)
        self._draw_vehicle(position, moment)
        canvas.clip()
        self._write(moment)

    def _fit(self, points: np.ndarray) -> None:
        """Choose scale and middle so that all points are in the picture."""
        flat = points @ PROJECTION
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH, HEIGHT]) - 2 * MARGIN
        size = float(np.max((high - low) * room[0] / room))
        self._scale = room[0] / round_up(max(size, LEAST_SIZE))
        self._middle = np.array([WIDTH, HEIGHT]) / 2 - self._scale * (low + high) / 2

    def _at(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) projected into the picture, (..., 2) [px]."""
        return np.asarray(points) @ PROJECTION * self._scale + self._middle

    def _on_bottom(self, points: np.ndarray, floor: float) -> np.ndarray:
        return self._at(np.asarray(points) * [1.0, 1.0, 0.0] + [0.0, 0.0, floor])

    def _draw_grid(self, low: np.ndarray, high: np.ndarray, floor: float) -> None:
        canvas, step = self._canvas, round_up(60.0 / self._scale)
        first, last = np.floor(low[:2] / step) * step - step, np.ceil(high[:2] / step) * step + step
        corners = [(first[0], first[1]), (last[0], first[1]), (last[0], last[1]), (first[0], last[1])]
        canvas.polygon(self._at(np.array([(*corner, floor) for corner in corners])), BOTTOM)
        for north in np.arange(first[0], last[0] + step / 2, step):
            canvas.lines(self._at(np.array([(north, first[1], floor), (north, last[1], floor)])), GRID, 0.75)
        for east in np.arange(first[1], last[1] + step / 2, step):
            canvas.lines(self._at(np.array([(first[0], east, floor), (last[0], east, floor)])), GRID, 0.75)
        canvas.text(f"grid {number(step, 0 if step >= 1 else 1)} m", (WIDTH - 8, HEIGHT - 10), 10, SOFT_INK, 1.0)

    def _draw_band(self, columns: dict[str, np.ndarray], position: np.ndarray) -> None:
        """The ellipse of two standard deviations of the position, with independent components."""
        mean = np.array([newest(columns, f"estimated_{name}") for name in ("x", "y", "depth")])
        std = np.array([newest(columns, f"estimated_{name}_std") for name in ("x", "y", "depth")])
        if not np.isfinite(mean + std).all():
            return
        spread = PROJECTION.T @ np.diag(std**2) @ PROJECTION
        variances, axes = np.linalg.eigh(spread)
        angles = np.linspace(0.0, 2.0 * math.pi, 48)
        circle = np.stack([np.cos(angles), np.sin(angles)])
        radii = np.maximum(SIGMAS * self._scale * np.sqrt(np.maximum(variances, 0.0)), 3.0)
        self._canvas.polygon(self._at(mean) + (axes @ (radii[:, None] * circle)).T, BAND)

    def _draw_vehicle(self, position: np.ndarray, moment: ChartEntry) -> None:
        axes = attitude(moment.phi, moment.theta, moment.psi)
        if not np.isfinite(axes).all():
            return
        canvas, flat = self._canvas, axes @ PROJECTION * LENGTH  # body axes in the picture, (3, 2)
        middle = self._at(position)
        for side in (flat[1], flat[2]):
            ends = [middle + FIN_PLACE * flat[0] + sign * FIN_SPAN * side for sign in (-1.0, 1.0)]
            canvas.lines(ends, FIN, 2.5)
        across = np.array([-flat[0][1], flat[0][0]])
        across = across / max(float(np.hypot(*across)), 1e-6) * LENGTH
        along, radius = OUTLINE[:, 0], np.maximum(OUTLINE[:, 1], 0.0)
        # Seen end on the hull is a disc, whose radius is that amidships.
        canvas.dots([middle], 0.1 * LENGTH, HULL)
        right = middle + along[:, None] * flat[0] + radius[:, None] * across
        left = middle + along[:, None] * flat[0] - radius[:, None] * across
        outline = np.concatenate([right, left[::-1]])
        canvas.polygon(outline, HULL)
        canvas.lines(np.concatenate([outline, outline[:1]]), FIN, 1.0)

    def _write(self, moment: ChartEntry) -> None:
        write = self._canvas.text
        write(f"{number(moment.time, 2)} s", (12, 14), 13, INK)
        where = ", ".join(number(value, 1) for value in (moment.x, moment.y, moment.depth))
        write(f"north, east, down: {where} m", (84, 14), 11, SOFT_INK)
        self._draw_compass()

    def _draw_compass(self) -> None:
        """Arrows to the north, to the east and down."""
        origin = np.array([26.0, HEIGHT - 40.0])
        for axis, name in enumerate("NED"):
            tip = origin + 26.0 * PROJECTION[axis]
            self._canvas.arrow(origin, tip, 2.5, SOFT_INK)
            outside = origin + 36.0 * PROJECTION[axis]
            self._canvas.text(name, outside, 10, SOFT_INK, 0.5)
        self._canvas.disc(origin, 2.0, WHITE)


def attitude(phi: float, theta: float, psi: float) -> np.ndarray:
    """The body's axes ahead, to starboard and down, (3, 3) by rows, in north, east, down."""
    from thruster_env.auv.dynamics import attitude_of, in_earth_axes

    angles = attitude_of(phi, theta)
    return np.array([in_earth_axes(angles, psi, *unit) for unit in np.eye(3).tolist()])


def _points(columns: dict[str, np.ndarray], prefix: str) -> np.ndarray:
    return np.stack([columns[f"{prefix}{name}"] for name in ("x", "y", "depth")], axis=-1)


def _part_in_view(path: np.ndarray, visited: np.ndarray) -> np.ndarray:
    """A path's points; of a single straight line a part from the vehicle's trail to some way ahead."""
    if len(path) > 2:
        return path
    piece = path[1] - path[0]
    along = (visited - path[0]) @ piece / (piece @ piece) if len(visited) else np.zeros(1)
    distances = np.linspace(along.min(), along.max() + 2.0 / np.linalg.norm(piece), 100)
    return path[0] + distances[:, None] * piece


def _runs(points: np.ndarray) -> list[np.ndarray]:
    """Runs of points (K, 3) without NaN."""
    return [points[run] for run in runs(np.isfinite(points).all(axis=1))]


LEFT = 498  # of the dials' panel [px]
DIAL, RADIUS = 548, 27  # their middle and radius [px]
TOP, GAUGE_HEIGHT = 258, 104  # of the gauges [px]
THRUST, STERN, RUDDER = 528, 572, 616  # their middle [px]


class Dials:
    """Pitch seen from port, roll seen from astern, yaw seen from above; the estimate is a line across the dial."""

    def __init__(self, canvas: Canvas, bottom: float):
        """Draw what never moves, down to a height of the picture [px]."""
        self._canvas = canvas
        canvas.box(LEFT, 0, SIZE[0] - LEFT, bottom, PANEL)
        canvas.box(LEFT, 0, 1, bottom, (186, 200, 210))
        self._middles = [bottom * (2 * k + 1) / 6 for k in range(3)]
        for y in self._middles:
            canvas.disc((DIAL, y), RADIUS + 1.5, (196, 206, 214))
            canvas.disc((DIAL, y), RADIUS, WHITE)
        for y in self._middles[:2]:
            canvas.box(DIAL - RADIUS, y - 0.4, 2 * RADIUS, 0.8, FAINT)

    def draw(self, columns: dict[str, np.ndarray], moment: ChartEntry) -> None:
        """Draw the newest attitude."""
        pitch, roll, yaw = self._middles
        # Directions of the nose in the picture: from port it points left, so that pitching up turns it clockwise.
        self._hull((DIAL, pitch), math.pi + moment.theta)
        self._tail((DIAL, roll), moment.phi)
        self._hull((DIAL, yaw), moment.psi - math.pi / 2)
        for y, name, value, turn in (
            (pitch, "theta", moment.theta, math.pi),
            (roll, "phi", moment.phi, 0.0),
            (yaw, "psi", moment.psi, -math.pi / 2),
        ):
            estimate = newest(columns, f"estimated_{name}")
            if math.isfinite(estimate):
                self._line((DIAL, y), turn + estimate)
            self._write(y, name, value, estimate)
        self._canvas.text("N", (DIAL, yaw - RADIUS + 6), 9, SOFT_INK, 0.5)

    def _write(self, y: float, name: str, value: float, estimate: float) -> None:
        title = {"theta": "pitch", "phi": "roll", "psi": "yaw"}[name]
        write, x = self._canvas.text, DIAL + RADIUS + 7
        write(title, (x, y - 14), 11, INK)
        write(number(_degrees(value), 1) + "\u00b0", (x, y + 1), 11, INK)
        if math.isfinite(estimate):
            write(number(_degrees(estimate), 1) + "\u00b0", (x, y + 15), 11, ESTIMATE)

    def _hull(self, middle, angle: float) -> None:
        if not math.isfinite(angle):
            return
        ahead = np.array([math.cos(angle), math.sin(angle)]) * 1.55 * RADIUS
        across = np.array([-ahead[1], ahead[0]])
        along, radius = OUTLINE[:, :1], OUTLINE[:, 1:]
        centre = np.array(middle)
        for side in (-0.17, 0.17):
            self._canvas.lines([centre - 0.42 * ahead, centre - 0.46 * ahead + side * across], FIN, 2.5)
        outline = np.concatenate([along * ahead + radius * across, (along * ahead - radius * across)[::-1]])
        self._canvas.polygon(centre + outline, HULL)

    def _tail(self, middle, phi: float) -> None:
        if not math.isfinite(phi):
            return
        centre = np.array(middle)
        for turn in (phi, phi + math.pi / 2):
            arm = 0.72 * RADIUS * np.array([math.cos(turn), math.sin(turn)])
            self._canvas.lines([centre - arm, centre + arm], FIN, 2.5)
        self._canvas.disc(middle, 0.42 * RADIUS, HULL)

    def _line(self, middle, angle: float) -> None:
        arm = RADIUS * np.array([math.cos(angle), math.sin(angle)])
        self._canvas.lines([np.array(middle) + 0.75 * arm, np.array(middle) + 1.1 * arm], ESTIMATE, 3)


class Gauges:
    """Thrust and both planes as bars from zero."""

    def __init__(self, canvas: Canvas, max_thrust: float, max_plane: float):
        """Draw what never moves; full scales are max_thrust [N] and max_plane [rad]."""
        self._canvas = canvas
        top = max(math.degrees(max_plane), 1e-3)
        self._axes = {
            THRUST: Axis(0.0, max_thrust, TOP, GAUGE_HEIGHT),
            STERN: Axis(-top, top, TOP, GAUGE_HEIGHT),
            RUDDER: Axis(-top, top, TOP, GAUGE_HEIGHT),
        }
        draw_gauge_frames(canvas, self._axes, TOP, GAUGE_HEIGHT)

    def draw(self, moment: ChartEntry) -> None:
        """Draw thrust and planes at a moment."""
        values = {THRUST: moment.thrust, STERN: math.degrees(moment.stern), RUDDER: math.degrees(moment.rudder)}
        for (x, axis), title in zip(self._axes.items(), ("thrust", "stern", "rudder"), strict=True):
            canvas, value = self._canvas, values[x]
            draw_gauge(canvas, title, x, axis, value)
            canvas.box(x - 7, axis.y(0.0) - 0.4, 14, 0.8, SOFT_INK)
            text = number(value, 2) + " N" if x == THRUST else number(value, 1) + "\u00b0"
            canvas.text(text, (x, TOP + GAUGE_HEIGHT + 14), 11, INK, 0.5)


def _degrees(angle: float) -> float:
    """An angle in degrees within half a turn."""
    return math.degrees(math.remainder(angle, 2.0 * math.pi)) if math.isfinite(angle) else math.nan
