"""Mistakes that people make in a filter's page are named where they are made."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from filters import thruster_model
from filters.filter import PageFilter
from filters.gaussian import extended
from filters.pages.page import Page

GENERATOR = np.random.default_rng(1)  # a page must not draw: the number would be frozen


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


def drawing(model, x, P, z):
    after, P, *rest = extended.update(model, x, P, z)
    return after * GENERATOR.normal(), P, *rest


def of_other_sizes(model, x, P, z):
    return extended.update(model, x + z, P, z)


def swapped(model, x, P, z):
    x, P, v, S, level = extended.update(model, x, P, z)
    return x, P, S, v, level


def without_density(model, x, P, z):
    *results, _ = extended.update(model, x, P, z)
    return *results, 0.0


def to_a_power(model, x, P, z):
    return x, P @ model.R**-1


def divided(model, x, P, z):
    return x, P @ model.H(x).T / model.R


def comparing(model, x, P, z):
    return x if x > 0 else -x


def of_an_identity(model, x, P, z):
    return x, P + 1e-9 * np.eye(2)


def misspelt(model, x, P, z):
    return x * model.own.fadding


def filter_of(update, fading=1.0):
    @dataclass(frozen=True, kw_only=True, eq=False)
    class Mistaken(PageFilter):
        name: ClassVar[str] = "mistaken"
        page: ClassVar[Page] = Page(extended.propagate, extended.add_process_noise, update, own=(("fading", ()),))
        fading: float = 1.0

    return Mistaken(model=thruster_model(), fading=fading)


@pytest.mark.parametrize(
    ("update", "error", "rule"),
    [
        (without_innovation, ValueError, "update of a page must return x, P, .* but it returned 2 values"),
        (inverted, TypeError, r"as divide\(C, S\) for C S\^-1, not functions of NumPy"),
        (drawing, ValueError, "must depend on its arguments alone: .* but two calls differ"),
        (of_other_sizes, TypeError, r"entries of one shape, but got \(2,\) and \(1,\)"),
        (swapped, ValueError, r"must return the innovation v of shape \(1,\), but got"),
        (
            without_density,
            ValueError,
            r"log density, log_density\(v, S, present\(z\)\) of shape",
        ),
        (to_a_power, TypeError, r"C S\^-1 as divide\(C, S\), as \*\* raises each entry"),
        (divided, TypeError, r"C S\^-1 as divide\(C, S\), as / divides each entry"),
        (comparing, TypeError, "choose by operations, .* but it compares .* with 0"),
        (of_an_identity, TypeError, r"\(eye\(P\) is the identity\), but got array"),
        (of_entries, TypeError, "without entries, by the operations of filters.algebra, but it takes 0 of"),
        (unpacked, TypeError, "without entries, but it goes through those of"),
        (branching, TypeError, "must not branch on values"),
        (misspelt, AttributeError, r"one of the filter's fields \(fading\), not 'fadding'"),
    ],
)
def test_a_mistake_in_a_page_is_named(update, error, rule):
    with pytest.raises(error, match=rule):
        filter_of(update).session()


def test_a_parameter_that_is_no_number_is_refused():
    with pytest.raises(ValueError, match="fading of mistaken must be a number, but got nan"):
        filter_of(extended.update, fading=np.nan).session()
