"""Canvas of the pictures: coordinates in pixels, smooth edges, text, and the colours.

pygame is imported with the first canvas, because every env imports this module and few draw.
"""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

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
