"""Functions that a factory writes at each call: equal ones stand for one another, and no others do."""

import collections
import functools
import gc
import math
import pickle
import types
import weakref
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from filters import make_filter, run
from tests.models import state_space
from thruster_env.core import equal_functions
from thruster_env.core.derivatives import runge_kutta
from thruster_env.core.equal_functions import captured_numbers, differ_in_numbers_alone, first_equal, with_numbers
from thruster_env.model.continuous import ContinuousModel

GAIN = 2.0


def with_number(value=1.0):
    def f(x):
        return value * x

    return f


def with_default(value=1.0):
    return lambda x, value=value: value * x


def with_keyword(value=1.0):
    return lambda x, *, value=value: value * x


def with_helper(value=1.0):
    def helper(x):
        return value * x

    return lambda x: helper(x)


def with_two_levels(value=1.0):
    def outer(x):
        def inner(y):
            return value * y

        return inner(x)

    return outer


def with_array(value=1.0):
    matrix = np.array([[1.0, value]])
    return lambda x: matrix[0, 0] * x + matrix[0, 1]


def with_large_array(value=1.0):
    matrix = np.full((40, 40), value)
    return lambda x: matrix[0, 0] * x


def with_list(value=1.0):
    numbers = [1.0, {"a": value}]
    return lambda x: numbers[1]["a"] * x


class Settings:
    def __init__(self, value):
        self.value = value

    def method(self, x):
        return self.value * x

    def __call__(self, x):
        return self.value * x


@dataclass(frozen=True)
class Frozen:
    value: float


def with_object(value=1.0):
    settings = Settings(value)
    return lambda x: settings.value * x


def with_frozen(value=1.0):
    settings = Frozen(value)
    return lambda x: settings.value * x


def with_namespace(value=1.0):
    settings = types.SimpleNamespace(value=value)
    return lambda x: settings.value * x


def with_method(value=1.0):
    return Settings(value).method


def with_partial(value=1.0):
    return functools.partial(lambda value, x: value * x, value)


def with_local_tuple(value=1.0):
    class Settings(NamedTuple):
        value: float

        def twice(self):
            return 2 * self.value

    settings = Settings(value)
    return lambda x: settings.twice() * x


def recursive(value=1.0):
    def f(x):
        return value if x <= 0 else x * f(x - 1)

    return f


def from_text(value=1.0):
    """As of a file that is run at each call: each has globals of its own."""
    names = {"value": value}
    exec("def helper(x):\n    return value * x\n\ndef f(x):\n    return helper(x)", names)
    return names["f"]


def decorated(value=1.0):
    @functools.wraps(abs)
    def f(x):
        return value * x

    return f


def with_local_class(value=1.0):
    class Plant:
        def __init__(self):
            self.gain = value

        def method(self, x):
            return self.gain * x

    return Plant().method


@dataclass(frozen=True, slots=True)
class Slots:
    value: float

    def __call__(self, x):
        return self.value * x


def with_slots(value=1.0):
    settings = Slots(value)
    return lambda x: settings.value * x


def with_callable(value=1.0):
    return Slots(value)


def with_mappings(value=1.0):
    numbers = types.MappingProxyType(collections.defaultdict(float, a=collections.OrderedDict(b=value)))
    return lambda x: numbers["a"]["b"] * x


def with_range(value=1.0):
    span = range(2), slice(1, 3)
    return lambda x: value * x * len(span[0]) * span[1].stop


def with_members_of_a_local_class(value=1.0):
    class Plant:
        gain = value

        @staticmethod
        def method(x):
            return Plant.gain * x

    return Plant.method


def with_cache(value=1.0):
    @functools.lru_cache
    def gain():
        return value

    return lambda x: gain() * x


def with_matrix(value=1.0):
    with pytest.warns(PendingDeprecationWarning):
        matrix = np.asmatrix([[1.0, value]])
    return lambda x: matrix[0, 1] * x


def with_module(value=1.0):
    module = types.ModuleType("settings")
    module.value = value
    return lambda x: module.value * x


NOT_COPIED = from_text, with_large_array, with_members_of_a_local_class, with_cache, with_matrix
FACTORIES = [
    *(with_number, with_default, with_keyword, with_helper, with_two_levels, with_array, with_large_array),
    *(with_list, with_object, with_frozen, with_namespace, with_method, with_partial, with_local_tuple),
    *(recursive, from_text, decorated, with_local_class, with_slots, with_callable, with_mappings, with_range),
    *(with_members_of_a_local_class, with_cache, with_matrix),
]


@pytest.mark.parametrize("make", FACTORIES)
def test_functions_with_equal_values_are_one_and_functions_with_other_values_are_not(make):
    one, again, other = make(), make(), make(3.0)
    assert one is not again
    first = first_equal(one)
    assert first_equal(again) == first and first_equal(first) == first
    assert first_equal(other) != first
    assert [first_equal(f)(2.0) for f in (one, again, other)] == [f(2.0) for f in (one, again, other)]


@pytest.mark.parametrize("values", [(1.0, 3.0), (-0.0, 1e300), (np.inf, 1e-300)])
@pytest.mark.parametrize("make", [make for make in FACTORIES if make not in NOT_COPIED])
def test_a_copy_with_the_numbers_of_another_function_is_that_function(make, values):
    one, other = map(make, values)
    assert differ_in_numbers_alone(one, other)
    assert with_numbers(one, captured_numbers(other))(2.0) == other(2.0)


@pytest.mark.parametrize("values", [(1.0, 1), (1.0, True), (0.0, -0.0), (1.0, np.float64(1.0)), (1.0, 1 + 0j)])
@pytest.mark.parametrize("make", [with_number, with_default, with_list, with_object])
def test_numbers_of_other_types_or_signs_are_not_equal(make, values):
    one, other = map(make, values)
    assert first_equal(one) is not first_equal(other)


def test_nan_is_equal_to_itself():
    one, again = with_number(math.nan), with_number(math.nan)
    assert first_equal(one) is first_equal(again)


def test_a_constant_in_the_code_counts_and_so_does_the_name():
    f, g, h = (lambda x: 2.0 * x), (lambda x: 3.0 * x), (lambda x: 2 * x)
    assert len({first_equal(f), first_equal(g), first_equal(h)}) == 3


def test_a_global_that_was_changed_is_another_value(monkeypatch):
    def make():
        return lambda x: GAIN * x

    one = first_equal(make())
    monkeypatch.setitem(globals(), "GAIN", 5.0)
    other = first_equal(make())
    assert other is not one and first_equal(make()) is other
    monkeypatch.setitem(globals(), "GAIN", 2.0)
    assert first_equal(make()) is one


def test_attributes_of_modules_and_classes_count(monkeypatch):
    class Holder:
        gain = 1.0

    def make(holder):
        return lambda x: holder.gain * x

    one = first_equal(make(Holder))
    assert first_equal(make(Holder)) is one
    Holder.gain = 2.0
    assert first_equal(make(Holder)) is not one
    assert first_equal(with_module()) is not first_equal(with_module())  # two modules


class Changed:
    gain = 2.0

    def method(self, x):
        return self.gain * x


CHANGED = Changed()


def read_global(x):
    return GAIN * x


def read_through_a_helper(x):
    return read_global(x)


def read_class(x):
    return Changed.gain * x


def read_object(x):
    return CHANGED.gain * x


def read_in_python(x):
    return read_global(float(x))  # which cannot be traced


READING = [read_global, read_through_a_helper, read_class, read_object, read_in_python]


def set_gain(monkeypatch, value):
    monkeypatch.setitem(globals(), "GAIN", value)
    monkeypatch.setattr(Changed, "gain", value)


@pytest.mark.parametrize(
    "make", [*(lambda f=f: f for f in READING), lambda: Changed().method, lambda: CHANGED.method]
)
def test_a_function_that_reads_other_values_than_before_is_another(make, monkeypatch):
    one = first_equal(make())
    set_gain(monkeypatch, 5.0)
    other = first_equal(make())
    assert other != one and first_equal(make()) == other == first_equal(other) and other(3.0) == 15.0
    set_gain(monkeypatch, 2.0)
    assert first_equal(make()) == one


def final_mean(function, name="ekf"):
    """The last estimate of a model that moves by a function, from a prior without measurements."""
    noise = {"q": [0.01], "r": [0.04]}
    model = state_space(
        lambda x, u, c: (function(x[0]),), lambda x, c: (x[0],), **noise, mean=[1.0], cov=[0.0], inputs=0
    )
    return run(make_filter(name, model), None, np.zeros((1, 2, 0)), np.full((1, 3, 1), np.nan)).means[0, -1, 0]


@pytest.mark.parametrize("function", READING)
def test_a_filter_of_a_model_that_is_made_again_reads_the_values_of_now(function, monkeypatch, as_python):
    assert final_mean(function) == 4.0
    set_gain(monkeypatch, 5.0)
    assert final_mean(function) == 25.0


@pytest.mark.parametrize("function", [read_through_a_helper, read_in_python])
def test_machine_code_of_a_model_that_is_made_again_reads_the_values_of_now(function, monkeypatch):
    assert final_mean(function) == 4.0
    set_gain(monkeypatch, 5.0)
    assert final_mean(function) == 25.0


def test_an_array_that_was_written_to_is_another_value():
    def make(matrix):
        return lambda x: matrix[0] * x

    matrix, equal = np.array([1.0]), np.array([1.0])
    one = first_equal(make(matrix))
    matrix[0] = 2.0
    other = first_equal(make(equal))
    assert other is not one and other(1.0) == 1.0


def count_calls():
    calls = []

    def f(x):
        calls.append(x)
        return x

    return f, calls


def count_in_place():
    count = {"calls": 0}

    def f(x):
        count["calls"] += 1
        return x

    return f, count


def count_by_cell():
    count = 0

    def f(x):
        nonlocal count
        count += 1
        return x

    return f, None


def count_by_attribute():
    count = types.SimpleNamespace(calls=0)

    def f(x):
        count.calls += 1
        return x

    return f, count


@pytest.mark.parametrize("make", [count_calls, count_in_place, count_by_cell, count_by_attribute])
def test_functions_that_change_what_they_hold_stay_apart(make):
    (one, _), (other, _) = make(), make()
    assert first_equal(one) is one and first_equal(other) is other


def test_functions_are_forgotten_with_their_last_user():
    gc.collect()
    before = len(equal_functions._first), len(equal_functions._used)
    functions = [first_equal(make(float(value))) for make in FACTORIES for value in range(5)]
    alive = [weakref.ref(f) for f in functions if isinstance(f, types.FunctionType)]
    del functions
    gc.collect()
    assert not any(one() for one in alive)
    assert (len(equal_functions._first), len(equal_functions._used)) == before


def test_functions_of_modules_are_themselves():
    assert first_equal(with_number) is with_number and first_equal(math.sin) is math.sin and first_equal(3) == 3


class Numbers(NamedTuple):
    gain: float
    substep: float = 0.1


def model_of(number=0.5, gain=1.0, jacobians=True, local_constants=False):
    class Constants(NamedTuple):
        gain: float

    def transition(x, u, c):
        return (x[0] + number * (u[0] - c[0] * x[0]),)

    def observe(x, c):
        return (number * x[0],)

    given = {}
    if jacobians:
        given["transition_jacobian"] = lambda x, u, c: ((1.0 - number * c[0],),)
        given["observe_jacobian"] = lambda x, c: ((number,),)
    given["constants"] = Constants(gain) if local_constants else (gain,)
    return state_space(transition, observe, q=[0.01], r=[0.04], mean=[0.0], cov=[1.0], inputs=1, **given)


def continuous(number=0.5, gain=1.0, named=False):
    channel = lambda x, c: number * x[0]  # noqa: E731 - as users write it
    return ContinuousModel(
        rates=lambda x, u, c: (number * (u[0] - c.gain * x[0]),),
        observe={"z": channel} if named else lambda x, c: (number * x[0],),
        densities=[0.1],
        constants=Numbers(gain),
        arguments={"measurement_noise_cov": [0.04], "prior_mean": [0.0], "prior_cov": [1.0], "inputs": 1},
    ).at(0.1)


@pytest.mark.parametrize(
    "make",
    [
        model_of,
        functools.partial(model_of, jacobians=False),
        functools.partial(model_of, local_constants=True),
        continuous,
        functools.partial(continuous, named=True),
    ],
)
def test_models_of_a_factory_share_what_is_compiled_for_them(make):
    one, other, different = make(gain=1.0), make(gain=2.0), make(number=0.25)
    assert (one.functions, one.shape) == (other.functions, other.shape)
    assert all(a is None or a != b for a, b in zip(one.functions, different.functions, strict=True))
    assert different.functions.observe((1.0,), different.given_constants) == (0.25,)


def test_makers_know_equal_rates():
    assert runge_kutta(with_rates(), 1) is runge_kutta(with_rates(), 1)


def with_rates():
    return lambda x, u, c: (-x[0],)


def test_functions_that_were_made_of_those_of_modules_can_still_be_pickled():
    made = ContinuousModel(
        rates=module_rates,
        observe=module_observe,
        densities=[0.1],
        constants=Numbers(1.0),
        arguments={"measurement_noise_cov": [0.04], "prior_mean": [0.0], "prior_cov": [1.0]},
    ).at(0.1)
    assert pickle.loads(pickle.dumps(made)).functions == made.functions


def module_rates(x, u, c):
    return (-c.gain * x[0],)


def module_observe(x, c):
    return (x[0],)
