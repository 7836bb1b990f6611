"""Pictures of the thruster at work, 640 x 400 pixels: in a window (`human`) or as arrays (`rgb_array`).

Above, the hull cut through at the thruster, with the propeller turning and arrows of the flow and of the push on
the ship; below, strip charts of the last 500 steps and gauges of thrust and voltage, with truth and measurement.
One step is one frame, so `render_fps = 1/dt` shows true speed.

The common parts of all plants' pictures, and how a filter shows its estimate, are in
`thruster_env.render`.

The upper half is a scheme, not to scale. One looks forward, port on the left. The motor stands above the tunnel
and turns the propeller through a right-angle gear. Positive flow goes to starboard and pushes the ship to port.

Needs pygame (the extra `render`), which is imported when a `Renderer` is made.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.render.canvas import (
    ABSURD,
    BAND,
    ESTIMATE,
    INK,
    MEASURED,
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
    with_band,
)
from thruster_env.render.renderer import PlantRenderer


class ChartEntry(NamedTuple):
    """The truth at the end of a step, one entry of the strip charts."""

    time: float  # since the start of the episode [s]
    omega_m: float  # motor speed [rad/s]
    U_a: float  # section-average flow velocity [m/s]
    thrust: float  # [N]
    measured_thrust: float  # [N]
    reference: float | None  # thrust to hold [N]
    voltage: float  # [V]
    ambient_velocity: float = 0.0  # U_0 [m/s]


class Overlay(NamedTuple):
    """The estimate of a filter at a step; None where it has none."""

    label: str  # name of the filter in the legend
    thrust: float | None = None  # [N]
    thrust_std: float | None = None  # standard deviation [N]
    omega_m: float | None = None  # [rad/s]
    omega_m_std: float | None = None  # [rad/s]
    U_a: float | None = None  # [m/s]
    U_a_std: float | None = None  # [m/s]


class Renderer(PlantRenderer):
    """Draws an episode: `begin` it, `add` every moment from the reset's on, `draw` where a frame is wanted.

    Its arguments, beside those of `PlantRenderer`, are gear_ratio, motor speed over propeller speed; diameter, of
    the propeller [m]; max_voltage, full scale of the voltage gauge [V]; and thrust_scale, speed_scale and
    flow_scale, thrust [N], motor speed [rad/s] and flow velocity [m/s] at full voltage, to which arrows are in
    proportion.
    """

    caption = "Bow thruster"
    moment, overlay = ChartEntry, Overlay
    positive = "gear_ratio", "diameter", "max_voltage", "thrust_scale", "speed_scale", "flow_scale"
    remembered = "_angle", "_angle_of_frame", "_angle_of_last_frame", "_count_of_frame", "_omega_m"

    def _make_pictures(self) -> None:
        canvas, arguments = self._canvas, self.arguments
        thrust, speed, flow = (arguments[f"{name}_scale"] for name in ("thrust", "speed", "flow"))
        self._scene = Scene(canvas, arguments["diameter"], arguments["gear_ratio"], thrust, flow)
        strips = (
            Strip("thrust", "thrust [N]", 1, 207, 66, thrust, "measured_thrust", "reference", False),
            Strip("omega_m", "motor speed [rad/s]", 1, 292, 38, speed),
            Strip("U_a", "flow [m/s]", 2, 349, 34, flow),
        )
        self._charts = Charts(canvas, strips, top=HEIGHT, dt=arguments["dt"])
        self._gauges = Gauges(canvas, arguments["max_voltage"])

    @property
    def blade_angle(self) -> float:
        """Angle that the propeller has turned since the episode began [rad]."""
        return self._angle

    def begin(self) -> None:
        """Start an episode: the strip charts are empty and a blade points up."""
        super().begin()
        self._angle = self._angle_of_frame = self._angle_of_last_frame = 0.0
        self._count_of_frame = 0
        self._omega_m = 0.0

    def add(self, moment: ChartEntry, overlay: Overlay | None = None) -> None:
        """Note a moment, dt after the one before; the first of an episode is that of the reset.

        Where the truth is not known, NaN, the propeller turns and the water flows as the filter believes.
        """
        omega_m = moment.omega_m
        if math.isnan(omega_m) and overlay is not None and overlay.omega_m is not None:
            omega_m = overlay.omega_m
        omega_m = omega_m if abs(omega_m) < ABSURD else 0.0
        if self._history.count:
            self._angle += 0.5 * (self._omega_m + omega_m) * self.arguments["dt"] / self.arguments["gear_ratio"]
        self._omega_m = omega_m
        super().add(moment, overlay)

    def _draw(self, columns: dict[str, np.ndarray], count: int, label: str) -> None:
        """Draw the newest moment, the propeller blurred by the angle that it turned since the last frame."""
        if count > self._count_of_frame:
            self._count_of_frame = count
            self._angle_of_last_frame, self._angle_of_frame = self._angle_of_frame, self._angle
        moment = ChartEntry(*(float(columns[name][-1]) for name in ChartEntry._fields))
        believed = {name: newest(columns, f"estimated_{name}") for name in ("omega_m", "U_a", "thrust")}
        moment = moment._replace(**{name: b for name, b in believed.items() if math.isnan(getattr(moment, name))})
        self._scene.draw(moment, self._angle_of_last_frame, self._angle_of_frame)
        self._gauges.draw(columns, self._charts.draw(columns, count - 1, label)[0])


HEIGHT = 186  # [px]
MIDDLE = 250  # the ship's centre line [px]
WATER, DECK, KEEL = 50, 30, 180  # [px]
AXIS, TUNNEL_RADIUS = 114, 33  # of the tunnel [px]
LEG = MIDDLE + 12  # where the leg carries the pod [px]
PROPELLER = MIDDLE - 18  # the propeller's plane [px]
PROPELLER_RADIUS = TUNNEL_RADIUS - 3
PORTHOLE, PORTHOLE_RADIUS = (572, 88), 52

SKY, SEA_TOP, SEA_BOTTOM = (241, 246, 249), (214, 231, 240), (172, 204, 221)
TUNNEL_WATER, ROOM, SHELL = (226, 240, 247), (250, 247, 240), (84, 99, 114)
FLOW, AMBIENT, FORCE = (22, 108, 140), (112, 158, 180), (176, 66, 52)
STEEL, DARK_STEEL, MOTOR = (150, 162, 173), (98, 111, 124), (86, 124, 110)
MARK = (255, 214, 90)

ARROW_HEIGHT = 22  # of the outer arrows above and below the axis [px]
IN_TUNNEL, OUTSIDE, AMBIENT_LENGTH, FORCE_LENGTH = 76, 100, 80, 130  # arrows at full scale [px]


class Scene:
    """Hull, tunnel, propeller and arrows."""

    def __init__(self, canvas: Canvas, diameter: float, gear_ratio: float, thrust_scale: float, flow_scale: float):
        """Draw what never moves onto the canvas, and the blades into tables; scales are for arrows [m, N, m/s]."""
        self._canvas = canvas
        self._diameter = diameter
        self._gear_ratio = gear_ratio
        self._thrust_scale = thrust_scale
        self._flow_scale = flow_scale
        self._side = side_view(PROPELLER_RADIUS)
        self._end = end_view(PORTHOLE_RADIUS - 4)
        self._draw_sea()
        self._draw_hull()
        self._draw_machinery()
        self._draw_porthole()

    def draw(self, moment: ChartEntry, start: float, end: float) -> None:
        """Draw what moves at a moment, the propeller blurred from one angle [rad] to another."""
        part = _limited(moment.U_a / self._flow_scale)
        ambient = _limited(moment.ambient_velocity / self._flow_scale)
        push = _limited(-moment.thrust / self._thrust_scale)  # water driven to starboard pushes the ship to port
        for height in (-ARROW_HEIGHT, ARROW_HEIGHT):  # the machinery is between them
            for side in (-64, 64):
                self._level_arrow(MIDDLE + side, AXIS + height, IN_TUNNEL * part, 4, FLOW)
        for height in (-ARROW_HEIGHT, 0, ARROW_HEIGHT):
            self._draw_jet(height, part)
        if ambient:
            self._level_arrow(70, HEIGHT - 14, AMBIENT_LENGTH * ambient, 3.5, AMBIENT)
        self._level_arrow(MIDDLE, 14, FORCE_LENGTH * push, 5.5, FORCE)
        self._draw_swept_angle(start, end)
        self._canvas.picture(self._side.mean(start, end), (PROPELLER, AXIS))
        self._canvas.picture(self._end.mean(start, end), PORTHOLE)
        self._write(moment)

    def _write(self, moment: ChartEntry) -> None:
        write, (x, y) = self._canvas.text, PORTHOLE
        write("propeller from port", (x, 15), 11, SOFT_INK, 0.5)
        write(number(moment.omega_m / self._gear_ratio * 30 / math.pi, 0) + " rpm", (x, y + 74), 15, INK, 0.5)
        write(f"\u00d8 {1000 * self._diameter:.0f} mm", (x, HEIGHT - 8), 10, SOFT_INK, 0.5)
        write("port", (12, WATER + 12))
        write("starboard", (SIZE[0] - 152, WATER + 12), align=1.0)
        write("push on the ship", (MIDDLE + 84, 14), 11, FORCE)
        write(f"{number(moment.time, 2)} s", (12, 14), 13, INK)
        if moment.ambient_velocity:
            write(f"ambient {number(moment.ambient_velocity, 2)} m/s", (12, HEIGHT - 28))

    def _draw_sea(self) -> None:
        canvas = self._canvas
        canvas.box(0, 0, SIZE[0], WATER, SKY)
        for y in range(WATER, HEIGHT):
            depth = (y - WATER) / (HEIGHT - WATER)
            canvas.box(0, y, SIZE[0], 1, [a + depth * (b - a) for a, b in zip(SEA_TOP, SEA_BOTTOM, strict=True)])
        canvas.box(0, WATER - 0.75, SIZE[0], 1.5, (132, 176, 199))

    def _draw_hull(self) -> None:
        canvas = self._canvas
        canvas.polygon(_section(DECK - 8, KEEL, 0), SHELL)
        canvas.polygon(_section(DECK - 9, DECK, 2.5), SKY)  # between the bulwarks
        canvas.polygon(_section(DECK + 3, KEEL - 3.5, 3.5), ROOM)
        for y in (AXIS - TUNNEL_RADIUS - 26, KEEL - 14):  # stringers
            for side in (-1, 1):
                shell = float(_half_breadth(y)) - 3
                canvas.lines([(MIDDLE + side * shell, y), (MIDDLE + side * (shell - 16), y)], (205, 203, 195), 1.5)
        top, bottom = AXIS - TUNNEL_RADIUS, AXIS + TUNNEL_RADIUS
        canvas.polygon(_section(top - 3, bottom + 3, 0), SHELL)
        canvas.polygon(_section(top, bottom, -0.5), TUNNEL_WATER)
        edge = _section(top, bottom, 0)
        for mouth in (edge[: len(edge) // 2], edge[len(edge) // 2 :]):  # the hull behind the cut
            canvas.lines(mouth, (150, 176, 192), 1)

    def _draw_porthole(self) -> None:
        canvas = self._canvas
        canvas.disc(PORTHOLE, PORTHOLE_RADIUS + 6, SHELL)
        canvas.disc(PORTHOLE, PORTHOLE_RADIUS - 1, TUNNEL_WATER)
        x, y = PORTHOLE
        canvas.box(x - 6, y - PORTHOLE_RADIUS + 1, 12, PORTHOLE_RADIUS, STEEL)  # the leg, behind the propeller

    def _draw_machinery(self) -> None:
        """Motor, leg and pod."""
        canvas, top = self._canvas, AXIS - TUNNEL_RADIUS
        canvas.polygon([(LEG - 7, top), (LEG + 7, top), (LEG + 5, AXIS), (LEG - 5, AXIS)], STEEL)
        canvas.box(PROPELLER, AXIS - 9, 66, 18, DARK_STEEL, 9)
        canvas.box(PROPELLER + 6, AXIS - 6, 50, 5, STEEL, 2.5)
        canvas.box(LEG - 16, top - 6, 32, 5, DARK_STEEL, 1)
        canvas.box(LEG - 5, top - 12, 10, 7, STEEL)
        canvas.box(LEG - 15, DECK + 9, 30, top - DECK - 21, MOTOR, 3)
        for x in range(LEG - 10, LEG + 11, 5):  # cooling ribs
            canvas.box(x - 0.75, DECK + 13, 1.5, top - DECK - 29, (64, 98, 86))

    def _draw_swept_angle(self, start: float, end: float) -> None:
        """A mark on the rim goes round with one blade; its tail is the angle turned since the last frame."""
        x, y = PORTHOLE
        radius = PORTHOLE_RADIUS + 2.5
        swept = max(-2 * math.pi, min(2 * math.pi, end - start))
        count = max(2, math.ceil(abs(swept) / 0.05))
        angles = end - np.linspace(swept, 0.0, count + 1)
        points = np.stack((x + radius * np.sin(angles), y - radius * np.cos(angles)), axis=-1)
        for k in range(count):
            fade = (k + 1) / count
            colour = [a + fade * (b - a) for a, b in zip(SHELL, MARK, strict=True)]
            self._canvas.lines(points[k : k + 2], colour, 3)
        self._canvas.disc(points[-1], 3, MARK)

    def _level_arrow(self, x: float, y: float, length: float, width: float, colour) -> None:
        self._canvas.arrow((x - length / 2, y), (x + length / 2, y), width, colour)

    def _draw_jet(self, height: float, part: float) -> None:
        """Water drawn in from all around on one side leaves as a jet on the other."""
        forward = -1 if part < 0 else 1
        mouth = float(_half_breadth(AXIS + height)) + 14
        for side, slope, length in ((-forward, 0.45, 0.6), (forward, 0.1, 1.0)):
            rise = slope * height / ARROW_HEIGHT
            near = np.array((MIDDLE + side * mouth, AXIS + height))
            away = np.array((side, rise)) / math.hypot(1, rise)
            far = near + away * OUTSIDE * length * abs(part)
            tail, tip = (near, far) if side == forward else (far, near)
            self._canvas.arrow(tail, tip, 4, FLOW)


def _half_breadth(y):
    """Half the breadth of the hull at a height of the picture [px]."""
    return 26 + 130 * np.clip((KEEL - np.asarray(y)) / (KEEL - DECK), 0, None) ** 0.55


def _section(top: float, bottom: float, inset: float) -> np.ndarray:
    """The hull between two heights, `inset` pixels inside its skin, as a polygon (n, 2)."""
    y = np.linspace(top, bottom, 60)
    breadth = _half_breadth(y) - inset
    left, right = np.stack((MIDDLE - breadth, y), axis=-1), np.stack((MIDDLE + breadth, y), axis=-1)
    return np.concatenate((left, right[::-1]))


def _limited(part: float) -> float:
    """A part of full scale within plus and minus 1.15; zero if it is not a number."""
    return max(-1.15, min(1.15, part)) if math.isfinite(part) else 0.0


TOP, GAUGE_HEIGHT = 210, 122  # of the gauges [px]
THRUST, VOLTAGE = 538, 612  # their middle [px]
NUMBERS = TOP + GAUGE_HEIGHT + 14  # where the first number below is [px]


class Gauges:
    """Thrust as truth (bar), measurement (dot), estimate (line in its band) and reference (triangle); voltage."""

    def __init__(self, canvas: Canvas, max_voltage: float):
        """Draw what never moves; max_voltage is the gauge's full scale [V]."""
        self._canvas = canvas
        self._voltage_axis = Axis(-max_voltage, max_voltage, TOP, GAUGE_HEIGHT)
        draw_gauge_frames(canvas, (THRUST, VOLTAGE), TOP, GAUGE_HEIGHT)

    def draw(self, columns, thrust_axis: Axis) -> None:
        """Draw the newest values; the thrust gauge has the ends of the thrust chart."""
        axis = thrust_axis._replace(top=TOP, height=GAUGE_HEIGHT)
        now = {name: float(values[-1]) for name, values in columns.items()}
        thrust, measured = now["thrust"], now["measured_thrust"]
        estimate, std = newest(columns, "estimated_thrust"), newest(columns, "estimated_thrust_std")
        self._draw_truth("thrust", THRUST, axis, thrust)
        self._draw_estimate(axis, estimate, std)
        self._draw_marks(axis, measured, now["reference"])
        numbers = [(number(thrust, 1) + " N", INK), (number(measured, 1) + " N", MEASURED)]
        if math.isfinite(estimate):
            numbers.append((with_band(estimate, std, 1) + " N", ESTIMATE))
        for line, (text, colour) in enumerate(numbers):
            self._canvas.text(text, (THRUST, NUMBERS + 15 * line), 11, colour, 0.5)
        self._draw_truth("voltage", VOLTAGE, self._voltage_axis, now["voltage"])
        self._canvas.text(number(now["voltage"], 1) + " V", (VOLTAGE, NUMBERS), 11, INK, 0.5)

    def _draw_truth(self, title: str, x: float, axis: Axis, value: float) -> None:
        """A bar from zero, with the axis left of it."""
        canvas = self._canvas
        draw_gauge(canvas, title, x, axis, value)
        for tick in {axis.low, axis.low / 2, 0.0, axis.high / 2, axis.high}:
            canvas.box(x - 10, axis.y(tick) - 0.5, 3, 1, SOFT_INK)
        axis.label(canvas, x - 17)

    def _draw_estimate(self, axis: Axis, estimate: float, std: float) -> None:
        x = THRUST + 10
        self._canvas.clip(x, TOP, 13, GAUGE_HEIGHT)
        if math.isfinite(estimate + std):
            high, low = axis.y(estimate + SIGMAS * std), axis.y(estimate - SIGMAS * std)
            self._canvas.box(x + 1, high, 11, max(1.0, low - high), BAND)
        if math.isfinite(estimate):
            self._canvas.box(x, axis.y(estimate) - 1, 13, 2, ESTIMATE)
        self._canvas.clip()

    def _draw_marks(self, axis: Axis, measured: float, reference: float) -> None:
        canvas, x = self._canvas, THRUST
        if math.isfinite(reference):
            y = axis.y(reference)
            canvas.polygon([(x - 16, y - 4.5), (x - 8, y), (x - 16, y + 4.5)], REFERENCE)
        if math.isfinite(measured):
            canvas.disc((x, axis.y(measured)), 4.5, WHITE)
            canvas.disc((x, axis.y(measured)), 3.5, MEASURED)


# The propeller seen from the side and end on, blurred by the angle that it turned while the frame was exposed.
#
# At full voltage a blade moves on to the place of the next in less than a step. Sharp pictures of every step
# would then seem to stand still or to turn backwards. A frame is the mean of all pictures between two angles, as
# from a camera whose shutter stays open from one frame to the next.


BLADES = 4
HUB = 0.26  # radius of the hub, of the propeller's
TABLE = 64  # pictures from one blade to the next
SMOOTH = 4  # a picture is drawn this many times larger and averaged
PITCH = math.pi / 6  # of the drawn blades, from the propeller's plane [rad]
BRONZE, DARK_BRONZE, HUB_BRONZE = np.array((205, 158, 92)), np.array((128, 92, 50)), (150, 112, 64)


class BlurredPicture:
    """Means over any range of angles of a picture that repeats from blade to blade.

    The mean from a to b is (S(b) - S(a)) / (b - a), S being the running sum of the pictures: exact, and as quick
    for a whole turn as for a degree.
    """

    def __init__(self, draw, size: tuple[int, int]):
        """Draw TABLE pictures with draw(surface, angle), angles in rad, size (width, height) in px."""
        import pygame

        width, height = size
        self._sums = np.zeros((TABLE + 1, height, width, 4), dtype=np.float32)
        for k in range(TABLE):
            large = pygame.Surface((width * SMOOTH, height * SMOOTH), pygame.SRCALPHA, 32)
            draw(large, (k + 0.5) / TABLE * 2 * math.pi / BLADES)
            # Averaged with empty surroundings of zeros, colours come out multiplied by their coverage.
            small = pygame.transform.smoothscale(large, size)
            pixels = np.frombuffer(pygame.image.tobytes(small, "RGBA"), np.uint8)
            self._sums[k + 1] = self._sums[k] + pixels.reshape(height, width, 4)

    def mean(self, start: float, end: float) -> np.ndarray:
        """The mean from one angle [rad] to another, premultiplied RGBA, (height, width, 4) of uint8."""
        low, high = (angle * BLADES * TABLE / (2 * math.pi) for angle in sorted((start, end)))
        if high - low < 1.0:  # finer than the table: as if it turned by one picture of it
            low = (low + high - 1.0) / 2
            high = low + 1.0
        before = math.floor(low / TABLE) * TABLE  # whole blades, which would only cost digits
        low, high = low - before, high - before
        return ((self._sum(high) - self._sum(low)) / (high - low) + 0.5).astype(np.uint8)

    def _sum(self, position: float) -> np.ndarray:
        rounds, position = divmod(position, TABLE)
        k = min(int(position), TABLE - 1)
        part = np.float32(position - k)
        return self._sums[-1] * np.float32(rounds) + (1 - part) * self._sums[k] + part * self._sums[k + 1]


@cache  # all renderers and their copies share the tables
def end_view(radius: float) -> BlurredPicture:
    """The propeller of a radius [px] seen from port, in a square around it; angles count clockwise from up."""
    import pygame

    r, half_width = _blade()

    def draw(surface, angle):
        middle = surface.get_width() / 2
        pixels = radius * SMOOTH
        for blade in range(BLADES):
            centre = angle + 2 * math.pi * blade / BLADES
            edge = half_width * math.cos(PITCH) / r
            around = np.concatenate((centre - edge, (centre + edge)[::-1]))
            out = np.concatenate((r, r[::-1])) * pixels
            outline = np.stack((middle + out * np.sin(around), middle - out * np.cos(around)), axis=-1)
            pygame.draw.polygon(surface, BRONZE.tolist(), outline.tolist())
            # The line where a blade is thickest, so that single blades are seen to turn.
            tip = (middle + 0.9 * pixels * math.sin(centre), middle - 0.9 * pixels * math.cos(centre))
            pygame.draw.line(surface, (176, 130, 72), (middle, middle), tip, SMOOTH)
        pygame.draw.circle(surface, HUB_BRONZE, (middle, middle), HUB * pixels)
        pygame.draw.circle(surface, (196, 152, 92), (middle, middle), HUB * pixels * 0.45)

    side = math.ceil(2 * radius)
    return BlurredPicture(draw, (side, side))


@cache
def side_view(radius: float) -> BlurredPicture:
    """The same propeller seen from the side, its axis level and water driven to the right, width 1.2 radii."""
    import pygame

    r, half_width = _blade()
    across = np.concatenate((-half_width, half_width[::-1]))  # along the blade's chord
    out = np.concatenate((r, r[::-1]))

    def draw(surface, angle):
        width, height = surface.get_size()
        pixels = radius * SMOOTH

        def draw_blade(centre):
            around = centre + across * math.cos(PITCH) / out
            axial = -across * math.sin(PITCH)  # the leading edge is upstream, to the left
            outline = np.stack((width / 2 + pixels * axial, height / 2 - pixels * out * np.cos(around)), axis=-1)
            light = 0.5 + 0.5 * math.sin(centre)  # blades at the back are in the shade
            pygame.draw.polygon(surface, (DARK_BRONZE + light * (BRONZE - DARK_BRONZE)).tolist(), outline.tolist())

        centres = [angle + 2 * math.pi * blade / BLADES for blade in range(BLADES)]
        behind = sorted((c for c in centres if math.sin(c) < 0), key=math.sin)
        front = sorted((c for c in centres if math.sin(c) >= 0), key=math.sin)
        for centre in behind:
            draw_blade(centre)
        hub = pygame.Rect(0, 0, 0.62 * pixels, 2 * HUB * pixels)
        hub.center = (round(width / 2), round(height / 2))
        pygame.draw.rect(surface, HUB_BRONZE, hub)
        cap = pygame.Rect(0, 0, 0.5 * pixels, hub.height)
        cap.center = hub.midleft
        pygame.draw.ellipse(surface, HUB_BRONZE, cap)
        for centre in front:
            draw_blade(centre)

    return BlurredPicture(draw, (math.ceil(1.2 * radius), math.ceil(2 * radius)))


def _blade() -> tuple[np.ndarray, np.ndarray]:
    """Radii from root to tip and half the blade's width there, of the propeller's radius.

    Wide at the tip, as blades in a tunnel are, with rounded corners.
    """
    r = np.concatenate((np.linspace(0.2, 0.9, 8), (0.94, 0.97, 0.99, 1.0)))
    half_width = 0.17 + 0.26 * (r - 0.2) / 0.8
    half_width[-4:] *= (0.97, 0.9, 0.78, 0.55)
    return r, half_width
