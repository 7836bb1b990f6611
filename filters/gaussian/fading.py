"""The extended Kalman filter with a fading memory: old measurements count less than its model says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.operations import sym
from filters.gaussian.extended import advance, update
from filters.pages.page_filter import Page, PageFilter
from thruster_env.core.checks import between


def settle(model, x, P):
    """The end of a step."""
    return x, sym(P * model.own.fading * model.own.fading + model.Q)


@dataclass(frozen=True, kw_only=True, eq=False)
class FadingMemoryFilter(PageFilter):
    """Extended Kalman filter with a fading memory.

        predict: x = f(x, u),  P = a^2 F P F' + Q;  update: the extended filter's

    A measurement k steps old counts a^-2k times as much as with a = 1. So the filter follows a model that drifts,
    even without any Q. P is that of errors which are weighted in this way.

    Attributes:
        fading: a, from 1, the extended filter, to 10.

    Raises:
        ValueError: if fading is out of its range.

    Source: Sorenson, Sacks (1971), "Recursive fading memory filtering"; Simon (2006), Optimal State Estimation,
    section 7.4.
    """

    name: ClassVar[str] = "fading"
    page: ClassVar[Page] = Page(advance, settle, update)
    fading: float = 1.01

    def __post_init__(self):
        """Check the number; raise ValueError that states the rule and the value."""
        object.__setattr__(self, "fading", between("fading", self.fading, 1.0, 10.0))
