"""Parameters of tests of which `make test` runs a few, and `make test-slow` the others."""

import pytest

SLOW = pytest.mark.slow


def slow_but(values, quick):
    """The values, all but the quick ones marked as slow."""
    return [one if one in quick else pytest.param(*_several(one), marks=SLOW) for one in values]


def _several(one):
    return one if isinstance(one, tuple) else (one,)
