"""What tests of filters check in many places."""

import pytest


def refused(rule, call, /, *arguments, **options):
    """Assert that a call raises ValueError in one line, which matches the rule."""
    with pytest.raises(ValueError, match=rule) as error:
        call(*arguments, **options)
    assert "\n" not in str(error.value)
