"""A filter that has a page: a class with its parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from filters.engine.belief import Kernels, bounded_kernels
from filters.filter import Filter
from filters.pages.kernels import page_kernels
from filters.pages.page import Page


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FilterWithPage(Filter):
    """Base of filters that have a page; subclasses set `page`, and add their parameters as fields.

    Attributes:
        page: its functions.
        unrolled: names of integer fields that count repetitions; each value has a program of its own. Other fields
            are numbers that programs read.
        ranges: the smallest and the largest value of each field that studies may tune.
        resampled: whether it has particles that are resampled; only the engine runs such a filter.
    """

    page: ClassVar[Page]
    unrolled: ClassVar[tuple[str, ...]] = ()
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    resampled: ClassVar[bool] = False

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Numbers and arrays that the page reads from `model.own`: by default the fields."""
        return {name: getattr(self, name) for name in self._fields() if name not in self.unrolled}

    @property
    def follows_from(self) -> Mapping[str, tuple[str, ...]]:
        """Parameters that are computed from numbers of the model when the filter is made, and these numbers."""
        return {}

    def _fields(self) -> Iterator[str]:
        return (field.name for field in dataclasses.fields(self) if field.name not in ("model", "form"))

    @cached_property
    def own_parameters(self) -> tuple[float, ...]:
        """The parameters, one behind the other."""
        return tuple(float(number) for value in self.parameters.values() for number in np.ravel(value))

    @property
    def plain_page(self) -> Page:
        """The page, with the shapes of the parameters."""
        parameters = tuple((name, np.shape(value)) for name, value in self.parameters.items())
        return self.page._replace(
            own=parameters, fixed=tuple((name, getattr(self, name)) for name in self.unrolled)
        )

    @property
    def written_page(self) -> Page:
        """The page that is run: by default the plain one."""
        return self.plain_page


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PageFilter(FilterWithPage):
    """Base of filters that have a page of mean and covariance; see `FilterWithPage`.

    Attributes:
        forms: pages of the same estimates in other arithmetic, by the value of the field `form`.
    """

    forms: ClassVar[Mapping[str, Page]] = {}

    @property
    def written_page(self) -> Page:
        """The page of the form, with the shapes of the parameters."""
        page = self.plain_page
        form = self.forms.get(getattr(self, "form", ""))
        return page if form is None else form._replace(own=page.own, fixed=page.fixed)

    @property
    def known_forms(self) -> tuple[str, ...]:
        """What the field `form` may be."""
        return "covariance", *self.forms

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        plain = page_kernels(self.written_page, self.kernel_model.functions, self.kernel_model.shape)
        bounds, bounded_by = self.model.bounds, self.model.bounded_by
        return bounded_kernels(plain, bounds, bounded_by) if bounds else plain


def with_page(filter_: Filter, what: str) -> FilterWithPage:
    """Return the filter; raise ValueError unless its page has no resampling and its model no bounds."""
    if not isinstance(filter_, FilterWithPage) or filter_.resampled:
        which = " without resampling" if isinstance(filter_, FilterWithPage) else ""
        raise ValueError(f"{what} must have a page{which}, as 'ekf' and 'enkf' have, but got {filter_.name!r}")
    if filter_.model.bounds:
        raise ValueError(f"{what} must have a model without bounds, but got {filter_.model.bounds}")
    return filter_
