"""A filter that runs a page on each part of a mixture: a class with its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from filters.engine.belief import Belief, Kernels
from filters.filter import Filter
from filters.gaussian.mixture import parts_of
from filters.gaussian.mixture_kernels import MixturePage, mixture_kernels

__all__ = ["MixtureFilter", "MixturePage"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MixtureFilter(Filter):
    """Base of filters that have a page for the parts of a mixture.

    Attributes:
        page: its functions.
    """

    page: ClassVar[MixturePage]

    @cached_property
    def parameters(self) -> Mapping[str, Any]:
        """Numbers and arrays that the page finds in `model.own`."""
        raise NotImplementedError

    @cached_property
    def of_parts(self) -> np.ndarray:
        """What each part has of its own, (parts,) or (parts, length)."""
        raise NotImplementedError

    @property
    def written_page(self) -> MixturePage:
        """The page, with what the fields say of it."""
        return self.page

    @cached_property
    def own_parameters(self) -> tuple[float, ...]:
        """The parameters, then what each part has of its own."""
        arrays = *self.parameters.values(), self.of_parts
        return tuple(float(number) for one in arrays for number in np.ravel(one))

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        model, shapes = self.kernel_model, tuple((name, np.shape(one)) for name, one in self.parameters.items())
        count, *own = np.shape(self.of_parts)
        return mixture_kernels(self.written_page, model.functions, model.shape, shapes, count, tuple(own))

    def part_estimates(self, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (parts, n), covariances (parts, n, n) and weights (parts,) of the parts of a belief."""
        return parts_of(belief.extras, len(self.of_parts), self.model.n)
