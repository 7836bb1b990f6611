"""The propeller seen from the side and end on, blurred by the angle that it turned while the frame was exposed.

At full voltage a blade moves on to the place of the next in less than a step. Sharp pictures of every step would
then seem to stand still or to turn backwards. A frame is the mean of all pictures between two angles, as from a
camera whose shutter stays open from one frame to the next.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pygame

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
