"""A window that shows pictures in real time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import pygame

from thruster_env.render.canvas import SIZE

LEAST_RATE = 20.0  # frames a second that are shown even if the steps come late [1/s]


class Window:
    """A window that keeps real time: it waits when it is early and leaves frames out when it is late."""

    def __init__(self, frame_time: float, caption: str, size: tuple[int, int] = SIZE):
        """Keep calls of `show` frame_time [s] apart; the window of a size [px] opens with the first."""
        self._size = size
        self._caption = caption
        self._frame_time = frame_time
        self._screen: pygame.Surface | None = None
        self._closed_by_hand = False

    def show(self, picture: Callable[[], pygame.Surface]) -> None:
        """Show a picture, unless it is late or the window was closed by hand, and wait until its time is over."""
        if self._closed_by_hand:
            return
        screen = self._screen
        if screen is None or not pygame.display.get_init():  # perhaps another env called pygame.quit()
            pygame.display.init()
            screen = self._screen = pygame.display.set_mode(self._size)
            pygame.display.set_caption(self._caption)
            self._due, self._shown = time.perf_counter(), -math.inf
        if pygame.event.get((pygame.QUIT, pygame.WINDOWCLOSE)):  # all other events are left to the caller
            self.close()
            self._closed_by_hand = True
            return
        start = time.perf_counter()
        if start <= self._due + self._frame_time or start - self._shown > 1 / LEAST_RATE:
            screen.blit(picture(), (0, 0))
            pygame.display.flip()
            self._shown = start
        now = time.perf_counter()
        # Time lost is made up for a little, not after a pause of whole seconds.
        self._due = max(self._due + self._frame_time, now - 2 / LEAST_RATE)
        time.sleep(max(0.0, self._due - now))

    def close(self) -> None:
        """Close the window."""
        self._closed_by_hand = False
        if self._screen is not None:
            pygame.display.quit()
            self._screen = None
