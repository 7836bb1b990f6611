"""Ensembles whose update is more than their page: where there is only that, they are refused."""

from __future__ import annotations

from filters.ensembles.ensemble import EnsembleFilter


def check_page_is_all(filter_: EnsembleFilter, where: str) -> None:
    """Raise ValueError for an ensemble whose update is more than its page, which is all that there is `where`."""
    if getattr(filter_, "rotations", 0):
        raise ValueError(f"an ensemble {where} must have no random rotations, but got rotations=1")
    if filter_.by_parts:
        rule = f"an ensemble {where} must have a page for its whole update, as 'etkf' has"
        raise ValueError(f"{rule}, but got {named(filter_)}")


def named(filter_: EnsembleFilter) -> str:
    """The name of a filter, with what makes its update more than its page."""
    chosen = ((name, getattr(filter_, name, 0)) for name in ("radius", "window"))
    return f"{filter_.name!r}" + "".join(f" with a {name} of {number:g}" for name, number in chosen if number)
