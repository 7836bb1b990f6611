"""Analyses by parts: of each state with the channels near it, or of each channel in turn with the states near it.

The page of such a filter says how members move, and what they expect; its own update moves none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, ClassVar

import numpy as np

from filters.engine.belief import Kernels
from filters.ensembles.deterministic import DeterministicUpdateFilter
from filters.ensembles.localised import LocalisedFilter
from filters.ensembles.parts import kernels_by_parts
from filters.ensembles.rotation import with_rotation
from filters.ensembles.steps import compare
from filters.pages.page import Page

LEAST = 1e-3  # tapers below are zero


def look(model, x, z, e):
    """The update of a page that moves no member."""
    _, _, v, S, _, level = compare(model, x, z)
    return x, v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalisedByParts(LocalisedFilter, DeterministicUpdateFilter):
    """Base of those whose update goes through states or channels, if there is a radius.

    Channels with correlated noise are first made independent, by the lower triangular root of R, and lie where
    they lay. Such an update is neither in C nor on tensors.
    """

    moves_of: ClassVar[Callable | None] = None  # of one channel after the other, see `kernels_by_parts`

    @property
    def by_parts(self) -> bool:
        """Whether the update is by parts."""
        return bool(self.radius)

    @property
    def tapers(self) -> Mapping[str, Any]:
        """Tapers between states and channels, (n, m), and the normal quantile of 1/(N + 1); none without parts."""
        if not self.by_parts:
            return {}
        taper = super().tapers.get("taper", np.ones((self.model.n, self.model.m)))
        tail = NormalDist().inv_cdf(1.0 / (self.ensemble_size + 1))
        return {"taper": np.where(taper > LEAST, taper, 0.0), "tail": tail}

    @property
    def plain_page(self) -> Page:
        """The page without what controls the spread; one that goes by parts moves no member in an update."""
        page = super().plain_page
        return page._replace(update=look) if self.by_parts else page

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        if not self.by_parts:
            return super().kernels()
        page, model = self.page_with(self.inflation != 1.0, relaxation=False), self.kernel_model
        kernels = kernels_by_parts(page, model.functions, model.shape, type(self).moves_of)
        return with_rotation(kernels) if self.rotations else kernels
