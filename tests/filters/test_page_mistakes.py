"""Mistakes that people make in a filter's page are named where they are made."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from filters import thruster_model
from filters.filter import PageFilter
from filters.gaussian import extended
from filters.pages.page import Page


def without_innovation(model, x, P, z):
    return extended.update(model, x, P, z)[:2]


def inverted(model, x, P, z):
    return x + P @ model.H(x).T @ np.linalg.inv(model.R) @ z


def of_entries(model, x, P, z):
    return x + z[0]


def unpacked(model, x, P, z):
    (thrust,) = z


def branching(model, x, P, z):
    return x if z else x


def misspelt(model, x, P, z):
    return x * model.own.fadding


@pytest.mark.parametrize(
    ("update", "error", "rule"),
    [
        (without_innovation, ValueError, "update of a page must return x, P, .* but it returned 2 values"),
        (inverted, TypeError, r"as divide\(C, S\) for C S\^-1, not functions of NumPy"),
        (of_entries, TypeError, "without entries, by the operations of filters.algebra, but it takes 0 of"),
        (unpacked, TypeError, "without entries, but it goes through those of"),
        (branching, TypeError, "must not branch on values"),
        (misspelt, AttributeError, r"one of the filter's fields \(fading\), not 'fadding'"),
    ],
)
def test_a_mistake_in_a_page_is_named(update, error, rule):
    @dataclass(frozen=True, kw_only=True, eq=False)
    class Mistaken(PageFilter):
        name: ClassVar[str] = "mistaken"
        page: ClassVar[Page] = Page(extended.propagate, extended.add_process_noise, update, own=(("fading", ()),))
        fading: float = 1.0

    with pytest.raises(error, match=rule):
        Mistaken(model=thruster_model()).session()
