"""Functions that run as Python: Python's floats, arithmetic of IEEE 754, exceptions that they catch."""

import contextlib
import functools
import math
import warnings

import numpy as np
import pytest

import filters
from filters import make_filter, run
from filters.c.programs import programs_of
from tests.models import state_space
from thruster_env.core.compiled import (
    Copies,
    caught,
    functions_in,
    interpreted,
    inverts,
    needs_floats,
    needs_python,
)
from thruster_env.core.streams import filter_keys
from thruster_env.graphs.python_floats import Floats, in_python

Z = np.array([0.3, 0.2, 0.5, 0.1])[None, :, None]


def untraced(value):
    """The value 1.0, by what no number that is not known yet can do."""
    return {value: 1.0}[value]


def adds(x, u, c):
    return ((x[0] > 0) + (x[1] > -1)) * 0.1 * untraced(x[0]), 0.5 * x[1]


def matches(x, u, c):
    match x[0] > 0.05:
        case True:
            return 0.5 * x[0], 0.1
        case False:
            return 0.5 * x[0], 0.2
    return math.nan, math.nan


def matches_far(x, u, c):  # where no point lies at which a graph is compared
    match x[0] > 50.0:
        case True:
            return 0.5 * x[0], 0.1
        case False:
            return 0.5 * x[0], 0.2
    return 0.5 * x[0], 0.2


def asks(x, u, c):
    return 0.5 * x[0], (0.1 if (x[0] > 50.0) is True else 0.2)


def catches(x, u, c):
    try:
        side = x[1] / abs(x[1])
    except ZeroDivisionError:
        side = 3.0
    return 0.5 * x[0] + 0.1 * side, 0.0 * x[1]


def catches_and_divides(x, u, c):
    try:
        side = x[1] / abs(x[1])
    except ZeroDivisionError:
        side = 3.0
    return 0.5 * x[0] + 0.1 * side, 1.0 / (0.2 / (0.0 * x[1]))


def catches_all(x, u, c):
    try:
        return 0.5 * math.sqrt(x[0]), 0.1
    except Exception:
        return 0.25, 0.2


def suppresses(x, u, c):
    side = 3.0
    with contextlib.suppress(ZeroDivisionError):
        side = x[1] / abs(x[1])
    return 0.5 * x[0] + 0.1 * side, 0.0 * x[1]


def divides_and_adds(x, u, c):
    far = 1.0 / (0.2 / (0.0 * x[0] * untraced(x[0])))
    return 0.1 * ((x[0] > -1.0) + (x[1] > -1.0)) + far, 0.5 * x[1]


def powers(x, u, c):
    low = x[1] ** 0.5 * untraced(0.0)
    return 0.5 * x[0], (0.1 if low != low else -0.2)


def leaves_the_domain(x, u, c):
    low = math.sqrt(x[1]) * untraced(0.0)
    return 0.5 * x[0], (0.1 if low != low else -0.2)


def overflows(x, u, c):
    return 0.5 * x[0], 0.1 / math.exp(1000.0 + x[0]) + 0.1 * untraced(0.0)


def model(transition, n=2, **changes):
    noise, prior = {"q": [0.1] * n, "r": [0.1]}, {"mean": [0.0] * n, "cov": [1.0] * n}
    return state_space(transition, lambda x, c: (x[0],), **noise, **prior, inputs=0, **changes)


def hears_nothing(transition, name="ekf", **changes):
    """What a filter predicts from (0, 0) in two steps without a measurement."""
    filter_ = make_filter(name, model(transition, **changes))
    estimates = run(filter_, filter_keys([0]), np.zeros((1, 2, 0)), np.full((1, 3, 1), np.nan))
    assert not estimates.divergences.any()
    return estimates.means[0, 1:]


EXPECTED = {
    adds: [(0.1, 0.0), (0.2, 0.0)],
    matches: [(0.0, 0.2), (0.0, 0.2)],
    matches_far: [(0.0, 0.2), (0.0, 0.2)],
    asks: [(0.0, 0.2), (0.0, 0.2)],
    catches: [(0.3, 0.0), (0.45, 0.0)],
    catches_and_divides: [(0.3, 0.0), (0.45, 0.0)],
    catches_all: [(0.0, 0.1), (0.0, 0.1)],
    suppresses: [(0.3, 0.0), (0.45, 0.0)],
    divides_and_adds: [(0.2, 0.0), (0.2, 0.0)],
    powers: [(0.0, -0.2), (0.0, 0.1)],
    leaves_the_domain: [(0.0, -0.2), (0.0, 0.1)],
    overflows: [(0.0, 0.1), (0.0, 0.1)],
}
WITHOUT_SLOPES = {"transition_jacobian": lambda x, u, c: ((0.0, 0.0), (0.0, 0.0))}  # across jumps there are none


@pytest.mark.filterwarnings("ignore:the model runs as Python")
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("transition", EXPECTED, ids=lambda f: f.__name__)
def test_filters_have_the_numbers_that_python_has_and_infinity_where_it_raises(transition, compiled):
    with contextlib.nullcontext() if compiled else interpreted():
        found = hears_nothing(transition, **WITHOUT_SLOPES)
    np.testing.assert_allclose(found, EXPECTED[transition], atol=1e-15)


def test_machine_code_is_made_of_no_function_that_catches_exceptions():
    """numba's `except Exception` catches no quotient by zero, for there it raises none."""
    filter_ = make_filter("open-loop", model(catches))
    with pytest.warns(
        UserWarning, match="runs as Python, some .* slower: catches .* line .* in Python alone: ask before"
    ):
        found = run(filter_, None, None, np.full((1, 2, 1), np.nan))
    np.testing.assert_allclose(found.means[0, 1], EXPECTED[catches][0])


def large(x, u, c):
    both = (x[0] > -1.0) + (x[1] > -1.0)
    match x[2] > 50.0:
        case True:
            side = 1.0
        case False:
            side = x[3] / abs(x[3])  # NaN
    for one in x[:2]:
        both += one > -1.0
    return [0.1 * both, 0.1 / (1.0 / (0.0 * x[4])), 0.1 if side != side else 0.2, *(0.5 * one for one in x[3:])]


def test_entries_of_arrays_are_numbers_of_python(as_python):
    f = model(large, 40).functions.transition
    with np.errstate(all="ignore"):
        found = f(np.zeros(40), (), ())
    np.testing.assert_array_equal(found, [0.4, 0.0, 0.1, *[0.0] * 37])
    values = np.arange(3.0).view(Floats)
    assert [type(one) for one in (values[1], values[1:][0], values.sum(), (values > 1.0)[2])] == [float] * 3 + [
        bool
    ]


def test_tensors_and_c_refuse_what_they_would_have_otherwise():
    pytest.importorskip("torch")
    for transition, rule in (
        (catches, "catches exceptions"),
        (suppresses, "catches"),
        (asks, "`is` True or False"),
    ):
        filter_ = make_filter("ekf", model(transition))
        for use in (lambda f: filters.torch(f).run(None, Z), programs_of):
            with pytest.raises(ValueError, match=rule) as refusal:
                use(filter_)
            assert "\n" not in str(refusal.value)


class Step:
    def __init__(self, gain=0.5):
        self.gain = gain

    def __call__(self, x, u, c):
        return self.gain * x[0], math.sin(x[1])

    def caught(self, x, u, c):
        return self.helper(x[0]), x[1]

    def helper(self, x):
        try:
            return self.gain / x
        except ZeroDivisionError:
            return 0.1


def test_methods_and_objects_are_traced_and_their_helpers_read(as_python):
    for transition in (Step(), Step().__call__, functools.partial(Step.__call__, Step())):
        np.testing.assert_array_equal(hears_nothing(transition), np.zeros((2, 2)))
        programs_of(make_filter("ekf", model(transition)))
    np.testing.assert_allclose(hears_nothing(Step().caught, **WITHOUT_SLOPES), [(0.1, 0.0), (5.0, 0.0)])
    assert [one.__name__ for one in functions_in(Step().caught)] == ["helper", "caught"]


def test_what_code_says_of_exceptions():
    def cleans_up(x):
        try:
            return 1.0 / x
        finally:
            x = 0.0

    def within(x):
        with np.errstate(all="ignore"):
            return [1.0 / one for one in (x, x)], (one for one in (x, x))

    def bare(x):
        try:
            return 1.0 / x
        except:  # noqa: E722
            return 0.0

    def inner(x):
        return bare(x)

    assert needs_python(cleans_up, within) is None and caught(within.__code__) == ()
    assert needs_python(inner).startswith("bare catches exceptions")
    assert needs_floats(matches).startswith("matches asks") and needs_python(matches) is None
    assert inverts((lambda x: ~(x > 0)).__code__) and not inverts(bare.__code__)


def test_a_function_s_own_error_is_raised_and_not_replaced(as_python):
    def refuses(x, u, c):
        if x[0] > 0.5:
            raise ValueError("level must be low")
        return x[0] + 1.0, untraced(x[1])

    with pytest.raises(ValueError, match="level must be low"):
        hears_nothing(refuses, **WITHOUT_SLOPES)
    assert in_python(lambda x: 1.0 / (x[0] > 1.0), [(np.float64(1.0),)]) == math.inf
    with pytest.raises(ZeroDivisionError):  # of NumPy's truth values the rest were 0, in machine code it is NaN
        in_python(lambda x: (x[0] > 0.0) % (x[0] > 1.0), [(np.float64(1.0),)])
    with pytest.raises(ZeroDivisionError):
        in_python(lambda x: 1.0 / len(x[1:]), [(1.0,)])


def test_a_class_whose_name_numpy_has_given_up_is_copied_in_silence():
    """Annotated functions of Python 3.14 hold `object`, and NumPy warns if asked for np.object."""
    with warnings.catch_warnings(action="error"):
        assert Copies(getattr, {}).of(object) is object
