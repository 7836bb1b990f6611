"""Canvas of the pictures, coordinates in pixels, smooth edges, text and colours; strip charts of the last steps.

pygame is imported with the first canvas, because every env imports this module and few draw.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import pygame

SIZE = (640, 400)  # [px]
SCALE = 4  # everything is drawn this many times larger and averaged: 16 samples a pixel, 4 ms a frame

# Truth, measurement, estimate and reference differ in lightness and in shape too. The hues are those of Okabe and
# Ito, which colour-blind people tell apart.
INK, SOFT_INK, FAINT = (31, 45, 61), (92, 108, 122), (222, 228, 233)
MEASURED, REFERENCE = (214, 116, 0), (0, 140, 105)
ESTIMATE, BAND = (16, 124, 208), (190, 222, 243)
PANEL, WHITE = (246, 248, 250), (255, 255, 255)
SIGMAS = 2  # half the width of a band, in standard deviations


class Canvas:
    """A picture laid out on 640 x 400 pixels; points are (x, y) in these, y downward, fractions allowed.

    At another size the picture is scaled to fit and centred.
    """

    def __init__(self, size: tuple[int, int] = SIZE):
        """A picture of a size [px]."""
        width, height = SIZE
        global pygame
        import pygame

        self.large = pygame.Surface((width * SCALE, height * SCALE), depth=32)
        self._zoom = min(size[0] / width, size[1] / height)
        inner = round(width * self._zoom), round(height * self._zoom)
        self._surface = pygame.Surface(size, depth=32)
        self._surface.fill(WHITE)
        corner = (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2
        self.small = self._surface.subsurface(pygame.Rect(corner, inner))
        self._fonts: dict[int, pygame.font.Font] = {}
        self._words: dict[tuple, pygame.Surface] = {}
        self._on_top: list[tuple] = []
        self._background = self.large

    def polygon(self, points, colour) -> None:
        """Fill a polygon, shape (n, 2); with two corners it is a line."""
        if len(points) < 3:
            self.lines(points, colour)
            return
        pygame.draw.polygon(self.large, colour, (np.asarray(points) * SCALE).round().tolist())

    def box(self, left, top, width, height, colour, radius: float = 0.0, line: float = 0.0) -> None:
        """Fill a rectangle with rounded corners, or draw its edge if line [px] is given."""
        rectangle = [round(value * SCALE) for value in (left, top, width, height)]
        pygame.draw.rect(self.large, colour, rectangle, round(line * SCALE), round(radius * SCALE))

    def disc(self, centre, radius: float, colour) -> None:
        """Fill a circle."""
        self.dots([centre], radius, colour)

    def dots(self, centres, radius: float, colour) -> None:
        """Fill a circle around each of the centres, shape (n, 2)."""
        for centre in (np.asarray(centres, dtype=float) * SCALE).tolist():
            pygame.draw.circle(self.large, colour, centre, radius * SCALE)

    def lines(self, points, colour, width: float = 1.0) -> None:
        """Draw a line through points, shape (n, 2); one point alone shows as a dot."""
        if len(points) < 2:
            self.dots(points, width / 2, colour)
        else:
            large = (np.asarray(points, dtype=float) * SCALE).tolist()
            pygame.draw.lines(self.large, colour, False, large, round(width * SCALE))

    def arrow(self, tail, tip, width: float, colour) -> None:
        """Draw an arrow that grows from a thin tail to a head; without length it shrinks to a dot."""
        (x, y), (dx, dy) = tail, (tip[0] - tail[0], tip[1] - tail[1])
        length = math.hypot(dx, dy)
        if length < width:
            self.disc((x + dx / 2, y + dy / 2), width / 2.5, colour)
            return
        head = min(2.6 * width, 0.6 * length)
        along, across = np.array((dx, dy)) / length, np.array((-dy, dx)) / length
        outline = [(0, 0.2), (length - head, 0.5), (length - head, 1.3), (length, 0)]
        outline += [(distance, -side) for distance, side in outline[2::-1]]
        self.polygon([(x, y) + distance * along + side * width * across for distance, side in outline], colour)

    def clip(self, left=0, top=0, width=SIZE[0], height=SIZE[1]) -> None:
        """Draw only inside a rectangle from now on; without arguments, everywhere again."""
        self.large.set_clip([round(value * SCALE) for value in (left, top, width, height)])

    def text(self, text: str, point, size: int = 11, colour=SOFT_INK, align: float = 0.0) -> int:
        """Write with the left (align 0), middle (0.5) or right (1) of the centre line at a point; its width [px].

        Text and pictures come on top of everything drawn, in the order of the calls.
        """
        key = text, size, colour
        if key not in self._words:
            if len(self._words) > 1000:  # numbers change all the time
                self._words.clear()
            self._words[key] = self._word(text, size, colour)
        word = self._words[key]
        (width, height), zoom = word.get_size(), self._zoom
        self._on_top.append((word, (round(zoom * point[0] - align * width), round(zoom * point[1] - height / 2))))
        return width if zoom == 1.0 else round(width / zoom)

    def picture(self, array: np.ndarray, centre) -> None:
        """Put a picture around a centre, (height, width, 4) of uint8, its colours multiplied by their coverage."""
        height, width, _ = array.shape
        image = pygame.image.frombuffer(array.tobytes(), (width, height), "RGBA")
        if self._zoom != 1.0:
            width, height = (max(1, round(side * self._zoom)) for side in (width, height))
            image = pygame.transform.smoothscale(image, (width, height))
        corner = round(self._zoom * centre[0] - width / 2), round(self._zoom * centre[1] - height / 2)
        self._on_top.append((image, corner, None, pygame.BLEND_PREMULTIPLIED))

    def keep(self) -> None:
        """Make what has been drawn so far the background of every frame."""
        self._background = self.large.copy()

    def finish(self) -> pygame.Surface:
        """Average the drawing down to the picture's size, add the top layer, and start again."""
        pygame.transform.smoothscale(self.large, self.small.get_size(), self.small)
        self.small.blits(self._on_top, False)
        self._on_top.clear()
        self.large.blit(self._background, (0, 0))
        return self._surface

    @staticmethod
    def as_array(surface: pygame.Surface) -> np.ndarray:
        """The pixels of a surface, (height, width, 3) of uint8."""
        width, height = surface.get_size()
        pixels = bytearray(pygame.image.tobytes(surface, "RGB"))
        return np.frombuffer(pixels, np.uint8).reshape(height, width, 3)

    def _word(self, text: str, size: int, colour) -> pygame.Surface:
        try:
            return self._font(size).render(text, True, colour)
        except pygame.error:  # another env was closed and has called pygame.quit(), which is the end of all fonts
            self._fonts.clear()
            return self._font(size).render(text, True, colour)

    def _font(self, size: int) -> pygame.font.Font:
        if size not in self._fonts:
            pygame.font.init()
            self._fonts[size] = pygame.font.Font(_font_file(), max(1, round(size * self._zoom)))
        return self._fonts[size]


def _font_file() -> str | None:
    """DejaVu Sans as it comes with matplotlib: a light face with Greek letters. pygame brings a bold face only."""
    spec = find_spec("matplotlib")
    path = (
        Path(spec.origin).parent / "mpl-data" / "fonts" / "ttf" / "DejaVuSans.ttf"
        if spec and spec.origin
        else None
    )
    return str(path) if path and path.is_file() else None


def number(value: float, digits: int) -> str:
    """A number with a true minus sign and no minus before zero; a dash if it is not finite."""
    if not math.isfinite(value):
        return "\u2013"
    return (f"{value:z.{digits}f}" if abs(value) < 1e6 else f"{value:.1e}").replace("-", "\u2212")


def with_band(value: float, std: float, digits: int) -> str:
    """An estimate with its band, where there is a standard deviation."""
    return number(value, digits) + (f" \u00b1 {number(SIGMAS * std, digits)}" if math.isfinite(std) else "")


ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)  # ends of an axis, up to powers of ten
LEAST = 0.02  # ends of an axis, of full scale, where nothing happens
MOST = 3.0  # ends of an axis, of full scale, whatever happens


class Axis(NamedTuple):
    """A vertical axis from `low`, zero or below, at the bottom to `high`, zero or above, at the top."""

    low: float
    high: float
    top: float  # [px]
    height: float  # [px]
    downward: bool = False  # with the larger values below

    def y(self, value):
        """Where a value is [px]; a value off the axis is somewhat off it, however large."""
        part = np.clip((value - self.low) / (self.high - self.low), -1, 2)
        return self.top + self.height * (part if self.downward else 1 - part)

    def label(self, canvas: Canvas, x: float) -> None:
        """Write zero and the ends, unless these are too near to it, left of x [px]."""
        for value in dict.fromkeys((0.0, self.low, self.high)):  # an end may be zero
            if not value or abs(self.y(value) - self.y(0.0)) > 9:
                canvas.text(number(value, _digits(value)), (x, self.y(value)), 10, align=1.0)


def fitting_axis(values: np.ndarray, scale: float, top: float, height: float) -> Axis:
    """An axis that contains all finite values, from LEAST to MOST of full scale."""
    values = np.clip(values[np.isfinite(values)], -MOST * scale, MOST * scale)
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    least = LEAST * scale if max(-low, high) < LEAST * scale else 0.0
    return Axis(-round_up(max(-low, least)), round_up(max(high, least)), top, height)


def round_up(value: float) -> float:
    """The next round number; 0 for what is not positive."""
    if not value > 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next((step * power for step in ROUND if step * power >= value), 10 * power)


def _digits(value: float) -> int:
    """Digits after the point that a round number needs."""
    return 0 if value == round(value) else max(1, 1 - math.floor(math.log10(abs(value))))


def draw_gauge_frames(canvas: Canvas, middles: Iterable[float], top: float, height: float) -> None:
    """Draw the frames of gauges about their middles [px]."""
    for middle in middles:
        canvas.box(middle - 7, top - 2, 14, height + 4, WHITE, 3)
        canvas.box(middle - 7, top - 2, 14, height + 4, (196, 206, 214), 3, 1)


def draw_gauge(canvas: Canvas, title: str, x: float, axis: Axis, value: float) -> None:
    """Draw a gauge's title and, if the value is finite, a bar from zero to it."""
    zero = axis.y(0.0)
    canvas.text(title, (x, axis.top - 13), 11, INK, 0.5)
    if math.isfinite(value):
        y = min(max(axis.y(value), axis.top), axis.top + axis.height)
        canvas.box(x - 5, min(y, zero), 10, abs(y - zero), (158, 172, 185))
        canvas.box(x - 9, y - 1.25, 18, 2.5, INK)


STEPS = 500  # that are remembered
ABSURD = 1e12  # states and estimates can diverge; beyond this a number is not drawn


class History:
    """The last moments of an episode, in columns: truth by its own name, beliefs as estimated_NAME.

    A moment is a tuple of numbers, or None where there is none; an overlay is a label and what a filter believes.
    """

    def __init__(self, moment: tuple[str, ...], overlay: tuple[str, ...]):
        """Take the names of a moment's entries, and of an overlay's behind the label."""
        self._names = (*moment, *(f"estimated_{name}" for name in overlay))
        self._of_moment = len(moment)
        self._rows = np.empty((STEPS, len(self._names)))
        self.clear()

    def clear(self) -> None:
        """Forget all of it."""
        self.count = 0  # moments added
        self.label = ""  # name of the filter

    def add(self, moment: tuple) -> None:
        """Note a moment."""
        row = self._rows[self.count % STEPS]
        row[: self._of_moment] = moment  # None becomes NaN
        row[self._of_moment :] = math.nan
        self.count += 1

    def amend(self, overlay: tuple) -> None:
        """Add a filter's estimate to the newest moment."""
        self.label = overlay[0]
        self._rows[(self.count - 1) % STEPS, self._of_moment :] = overlay[1:]

    def columns(self) -> dict[str, np.ndarray]:
        """An array (n,) for each name, oldest first, NaN where there is no value that can be drawn."""
        full = self.count > STEPS
        rows = np.roll(self._rows, -self.count, axis=0) if full else self._rows[: self.count]
        return dict(zip(self._names, np.where(np.abs(rows) < ABSURD, rows, math.nan).T, strict=True))


def newest(columns: dict[str, np.ndarray], name: str) -> float:
    """The newest value of a column; the previous one if a filter has not processed the last step yet."""
    last = columns[name][-2:]
    known = last[np.isfinite(last)]
    return float(known[-1]) if len(known) else math.nan


LEFT, RIGHT = 44, 486  # of the strip charts [px]
DASH = 6  # steps in a dash of the reference


class Strip(NamedTuple):
    """One strip chart."""

    name: str  # of the truth in the history
    title: str
    digits: int  # shown after the point
    top: float  # [px]
    height: float  # [px]
    scale: float  # full scale, in the unit of the quantity
    measured: str | None = None
    reference: str | None = None
    says_numbers: bool = True  # the newest ones, above the chart
    downward: bool = False  # as depths are


class Charts:
    """Strip charts and their legend, in the lower part of the picture."""

    def __init__(self, canvas: Canvas, strips: tuple[Strip, ...], *, top: float, dt: float):
        """Draw what never moves.

        Args:
            canvas: to draw on.
            strips: the charts, from above.
            top: where the panel that holds them begins [px].
            dt: sample time [s].
        """
        self._canvas = canvas
        self._span = dt * STEPS
        self._strips = strips
        canvas.box(0, top, SIZE[0], SIZE[1] - top, PANEL)
        canvas.box(0, top, SIZE[0], 1, (186, 200, 210))
        for strip in self._strips:
            canvas.box(LEFT, strip.top, RIGHT - LEFT, strip.height, WHITE)
            for fifth in range(6):
                canvas.box(LEFT + (RIGHT - LEFT) * fifth / 5 - 0.5, strip.top, 1, strip.height, FAINT)

    def draw(self, columns: dict[str, np.ndarray], last: int, label: str) -> list[Axis]:
        """Draw columns whose last entry is step number `last`; the axes of the charts.

        A label names the filter in the legend; "" if there is none.
        """
        axes = [self._draw_strip(columns, strip, last) for strip in self._strips]
        self._draw_legend(columns, label)
        for fifth in range(6):
            text = f"\u2212{self._span * (5 - fifth) / 5:.3g} s" if fifth < 5 else "now"
            x = LEFT + (RIGHT - LEFT) * fifth / 5
            self._canvas.text(text, (x, 391), 10, align=0.5)
        return axes

    def _draw_strip(self, columns, strip: Strip, last: int) -> Axis:
        canvas, count = self._canvas, len(columns[strip.name])
        x = RIGHT - np.arange(count)[::-1] * (RIGHT - LEFT) / STEPS
        estimate, std = columns[f"estimated_{strip.name}"], columns[f"estimated_{strip.name}_std"]
        compared = [columns[name] for name in (strip.measured, strip.reference) if name]
        values = np.concatenate((columns[strip.name], estimate, *compared))
        axis = fitting_axis(values, strip.scale, strip.top + 2, strip.height - 4)._replace(downward=strip.downward)

        def line(values, colour, width):
            for run in runs(np.isfinite(values)):
                canvas.lines(np.stack((x[run], axis.y(values[run])), axis=-1), colour, width)

        canvas.clip(LEFT, strip.top, RIGHT - LEFT, strip.height)
        low, high = axis.y(estimate - SIGMAS * std), axis.y(estimate + SIGMAS * std)
        for run in runs(np.isfinite(low)):
            outline = np.concatenate((low[run], high[run][::-1]))
            canvas.polygon(np.stack((np.concatenate((x[run], x[run][::-1])), outline), axis=-1), BAND)
        canvas.box(LEFT, axis.y(0.0) - 0.5, RIGHT - LEFT, 1, (170, 182, 192))
        if strip.measured:
            dots = np.stack((x, axis.y(columns[strip.measured])), axis=-1)
            canvas.dots(dots[np.isfinite(dots[:, 1])], 1.1, MEASURED)
        if strip.reference:
            dashes = np.arange(last - count + 1, last + 1) // DASH % 2 == 0
            line(np.where(dashes, columns[strip.reference], np.nan), REFERENCE, 1.5)
        line(estimate, ESTIMATE, 3)
        line(columns[strip.name], INK, 1.25)  # thin on thick: both are seen where they agree
        canvas.clip()
        axis.label(canvas, LEFT - 5)
        self._write(columns, strip)
        return axis

    def _write(self, columns, strip: Strip) -> None:
        """The title and the newest numbers; the first chart has the legend in their place."""
        write, x, y = self._canvas.text, RIGHT, strip.top - 9
        write(strip.title, (LEFT, y), 11, INK)
        if not strip.says_numbers:
            return
        estimate = newest(columns, f"estimated_{strip.name}")
        if np.isfinite(estimate):
            std = newest(columns, f"estimated_{strip.name}_std")
            x -= write(with_band(estimate, std, strip.digits), (x, y), 11, ESTIMATE, 1.0) + 14
        write(number(columns[strip.name][-1], strip.digits), (x, y), 11, INK, 1.0)

    def _draw_legend(self, columns, label: str) -> None:
        canvas, x, y = self._canvas, RIGHT, self._strips[0].top - 9
        entries = [("truth", INK), ("measured", MEASURED)]
        references = [strip.reference for strip in self._strips if strip.reference]
        if any(np.isfinite(columns[name]).any() for name in references):
            entries.append(("reference", REFERENCE))
        if label:
            entries.append((f"{label} \u00b1 {SIGMAS}\u03c3", ESTIMATE))
        for text, colour in reversed(entries):
            x -= canvas.text(text, (x, y), 11, colour, 1.0) + 5
            if colour == MEASURED:
                canvas.disc((x - 4, y), 2.5, colour)
                x += 8
            elif colour == REFERENCE:
                canvas.box(x - 16, y - 0.75, 6, 1.5, colour)
                canvas.box(x - 7, y - 0.75, 6, 1.5, colour)
            else:
                if colour == ESTIMATE:
                    canvas.box(x - 16, y - 4, 16, 8, BAND)
                thickness = 1.25 if colour == INK else 3
                canvas.box(x - 16, y - thickness / 2, 16, thickness, colour)
            x -= 28


def runs(drawn: np.ndarray) -> Iterator[slice]:
    """Slices of a boolean array that are true."""
    edges = np.flatnonzero(np.diff(np.concatenate(((False,), drawn, (False,)))))
    return (slice(start, stop) for start, stop in zip(edges[::2], edges[1::2], strict=True))
