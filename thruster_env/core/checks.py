"""Argument checks that state the rule, then the value; and progress of long computations to a listener."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from difflib import get_close_matches
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, Any, TypeVar

from thruster_env.core.modules import AtFirstUse

if TYPE_CHECKING:
    import numpy as np

if not TYPE_CHECKING:
    np = AtFirstUse("numpy")

FEW, MANY = 4, 8  # choices that a message names of more than so many
MOST_LISTED, LONG = 24, 80  # names that a message has, and characters of each
# Of correlations: least eigenvalues, and entries beside the diagonal.
ROUNDING, SINGULAR, ASYMMETRY = 1e-9, 1e-14, 1e-5


def short_repr(value) -> str:
    """A value for an error message, on one line and not too long."""
    try:
        text = " ".join(repr(value).split())
    except RecursionError:
        text = f"a {type(value).__name__} nested too deeply to be shown"
    return text if len(text) <= 200 else text[:197] + "..."


def as_floats(value) -> np.ndarray:
    """Return value as a float64 array, NaN and infinity included; raise ValueError unless it is real numbers.

    Text is no number, even "1.0", and neither are complex numbers. Missing entries become NaN: masked entries of
    masked arrays, alone or in a list, None and pandas.NA.
    """
    try:
        array = np.asarray(_unmasked(value))
        if array.dtype == object:
            array = _with_missing_as_nan(array)
        if array.dtype.kind not in "biufO":
            raise TypeError
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last of tensors, and of endless lists
        raise ValueError(f"an array must be one of numbers, but got {short_repr(value)}") from None


def _unmasked(value):
    if hasattr(value, "filled"):  # a masked array, known by what it has, because numpy.ma takes a while to import
        if value.dtype.kind == "O":
            return value.filled(math.nan)
        return np.ma.asarray(value, dtype=np.float64).filled(np.nan) if value.dtype.kind in "biuf" else None
    if isinstance(value, (list, tuple)) and any(
        isinstance(entry, (list, tuple)) or hasattr(entry, "filled") for entry in value
    ):
        return [_unmasked(entry) for entry in value]
    return value


def _with_missing_as_nan(array: np.ndarray) -> np.ndarray:
    """Replace None and pandas.NA in an array of objects by NaN; TypeError for None itself and for text."""
    entries = [
        math.nan if entry is None or type(entry).__name__ == "NAType" else entry
        for entry in array.ravel().tolist()
    ]
    if not array.ndim or any(isinstance(entry, (str, bytes)) for entry in entries):
        raise TypeError
    return np.array(entries, dtype=object).reshape(array.shape)


def finite(name: str, value) -> float:
    """Return value as a float; raise ValueError unless it is a finite number."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} must be a finite number, but got {short_repr(value)}")
    return number


def positive(name: str, value, *, zero_allowed: bool = False) -> float:
    """Return value as a float; raise ValueError unless it is finite and positive (or zero, where allowed)."""
    number = finite(name, value)
    if number < 0 or (number == 0 and not zero_allowed):
        rule = "zero or positive" if zero_allowed else "positive"
        raise ValueError(f"{name} must be {rule}, but got {short_repr(value)}")
    return number


def within(name: str, value, limit: float) -> float:
    """Return value as a float; raise ValueError unless it is finite and within plus and minus limit."""
    number = finite(name, value)
    if abs(number) > limit:
        raise ValueError(f"{name} must be within plus and minus {limit:g}, but got {short_repr(value)}")
    return number


def between(name: str, value, low: float, high: float, unit: str = "") -> float:
    """Return value as a float; raise ValueError unless it is a number from low to high [unit]."""
    number = finite(name, value)
    if not low <= number <= high:
        rule = f"from {low:g} to {high:g}" + (f" {unit}" if unit else "")
        raise ValueError(f"{name} must be {rule}, but got {short_repr(value)}")
    return number


def at_least(name: str, value, least: int, most: int | None = None) -> int:
    """Return value as an int; raise ValueError unless it is a whole number from `least` to `most`, if given."""
    number = finite(name, value)
    if number != int(number) or number < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, but got {short_repr(value)}")
    if most is not None and number > most:
        raise ValueError(f"{name} must be at most {most}, but got {short_repr(value)}")
    return int(number)


def switch(name: str, value) -> int:
    """Return value as an int; raise ValueError unless it is 0 or 1."""
    if at_least(name, value, 0) > 1:
        raise ValueError(f"{name} must be 0 or 1, but got {short_repr(value)}")
    return int(value)


def seed(value) -> int | None:
    """Return a reset's seed as an int or None; raise ValueError unless it is a whole number or None."""
    if value is None:
        return None
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < 0:
        raise ValueError(f"a seed must be None or a whole number of at least 0, but got {short_repr(value)}")
    return int(value)


def options(value) -> Mapping:
    """Return the options of a reset, {} for None; raise ValueError unless they are a mapping or None."""
    if value is not None and not isinstance(value, Mapping):
        raise ValueError(f"options must be None or a mapping, but got {short_repr(value)}")
    return {} if value is None else value


def one_of(name: str, value, choices: Iterable[str], listed: str | None = None) -> str:
    """Return value; raise ValueError, with the name that comes nearest, unless it is one of the choices.

    If there are many choices and one is near, the message lists the first few and names `listed`, the command that
    lists all.
    """
    known = tuple(choices)
    if not isinstance(value, str) or value not in known:
        near, choices_text = meant(value, known), ", ".join(known)
        if listed is not None and near and len(known) > MANY:
            choices_text = f"{', '.join(known[:FEW])} and {len(known) - FEW} more ({listed} lists all)"
        raise ValueError(f"{name} must be one of {choices_text}, but got {short_repr(value)}{near}")
    return value


def listed(names: Iterable[str]) -> str:
    """Names for a message, with commas between; of many the first, and how many there are more."""
    shortened = [name if len(name) <= LONG else f"{name[: LONG - 3]}..." for name in names]
    if len(shortened) <= MOST_LISTED:
        return ", ".join(shortened)
    return f"{', '.join(shortened[:MANY])} and {len(shortened) - MANY} more"


def in_words(parts: Sequence[str]) -> str:
    """At least one part in a sentence: "a, b and c"."""
    return " and ".join([*([", ".join(parts[:-1])] if parts[:-1] else []), parts[-1]])


def any_case(value, choices: Iterable[str]):
    """The choice that equals a value up to case; the value itself if there is none."""
    if isinstance(value, str):
        return next((choice for choice in choices if choice.casefold() == value.casefold()), value)
    return value


def meant(value, choices: Iterable[str]) -> str:
    """The end of a message on an unknown name: "; did you mean 'ekf'?", empty if no choice is near."""
    if not isinstance(value, str):
        return ""
    plain = {choice.casefold(): choice for choice in choices}
    near = get_close_matches(value.casefold(), plain, n=1)
    return f"; did you mean {plain[near[0]]!r}?" if near else ""


def vector(name: str, value, size: int | None = None) -> np.ndarray:
    """Return value as a float64 array of shape (size,), of any size if None; raise ValueError otherwise."""
    try:
        array = np.atleast_1d(as_floats(value).copy())
    except ValueError:
        array = np.full(0, np.nan)
    if array.ndim != 1 or not array.size or array.size != (size or array.size) or not np.isfinite(array).all():
        count = size or array.size or "some"
        rule = f"{name} must be {count} finite number{'' if count == 1 else 's'}"
        raise ValueError(f"{rule}, but got {short_repr(value)}")
    return array


def covariance(
    name: str,
    value,
    size: int,
    *,
    positive_definite: bool = False,
    variances: np.ndarray | None = None,
    largest: float = math.inf,
) -> np.ndarray:
    """Return a covariance, shape (size, size), from a matrix, `size` variances or one variance if size is 1.

    Raises ValueError unless it is symmetric and positive semidefinite (or definite, where that is asked), by its
    correlations: no unit matters. Rounding is a part of its variances, or of `variances` (size,) that are larger:
    those from which it was computed.
    """
    rule = f"{name} must be {size} variances or a symmetric {size} x {size} matrix"
    try:
        array = np.atleast_1d(as_floats(value))
    except ValueError:
        raise ValueError(f"{rule}, but got {short_repr(value)}") from None
    if array.shape == (size,):
        array = np.diag(array)
    if array.shape != (size, size) or not np.isfinite(array).all():
        raise ValueError(f"{rule} of finite numbers, but got {short_repr(value)}")
    least, asymmetry = correlation_flaws(array, variances)
    if asymmetry > ASYMMETRY:
        raise ValueError(f"{rule} of finite numbers, but got {short_repr(value)}")
    if np.abs(array).max() > largest:
        raise ValueError(f"{name} must be at most {largest:g} in every entry, but got {short_repr(value)}")
    if least < -ROUNDING:
        rule = "positive semidefinite (no negative variance, no covariance beyond what its variances allow)"
        raise ValueError(f"{name} must be {rule}, but got {short_repr(value)}")
    if positive_definite and least <= SINGULAR:
        raise ValueError(f"{name} must be positive definite, but got {short_repr(value)}")
    return (array + array.T) / 2


def correlation_flaws(covs: np.ndarray, variances: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Least eigenvalues (...) of the correlations of covariances (..., d, d), and how asymmetric these are.

    Neither depends on units. A least eigenvalue is -inf where a variance is negative, or zero beside a covariance
    that is not, or where correlations are beyond float64. Covariances are divided by `variances` (..., d) in place
    of their own where those are larger.
    """
    diagonal = np.diagonal(covs, axis1=-2, axis2=-1)
    units = np.sqrt(np.maximum(diagonal, 0.0 if variances is None else variances))
    known = units > 0.0
    divisors = np.where(known, units, 1.0)
    with np.errstate(over="ignore"):
        scaled = covs / divisors[..., None] / divisors[..., None, :]
    beyond = np.asarray(~np.isfinite(scaled).all(axis=(-1, -2)))
    scaled = np.where(beyond[..., None, None], 0.0, scaled)
    turned = np.swapaxes(scaled, -1, -2)
    least = np.linalg.eigvalsh(0.5 * (scaled + turned))[..., 0]
    alone = ~(known[..., None] & known[..., None, :]) & (covs != 0.0)
    impossible = (
        beyond | alone.any(axis=(-1, -2)) | ((diagonal < 0.0).any(axis=-1) if variances is None else False)
    )
    return np.where(impossible, -np.inf, least), np.abs(scaled - turned).max(axis=(-1, -2))


def correlations(cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A covariance in units of about its deviations, and these units (d,), powers of two: nothing is rounded.

    Results computed from it do not depend on the units of the components; the unit of a variance of 0 is 1.
    """
    variances = np.diag(cov)
    units = np.ldexp(1.0, np.where(variances > 0, np.frexp(np.sqrt(variances))[1], 0))
    return cov / units / units[:, None], units


def covariance_root(cov: np.ndarray) -> np.ndarray:
    """A lower triangular L with L L' = cov for a positive semidefinite covariance, zero variances allowed."""
    return _root(np.asarray(cov, dtype=np.float64).tobytes(), len(cov)).copy()


@lru_cache(maxsize=256)  # a study or map has the same prior all the time, and few values of Q or R
def _root(entries: bytes, size: int) -> np.ndarray:
    scaled, units = correlations(np.frombuffer(entries).reshape(size, size))
    eigenvalues, vectors = np.linalg.eigh(scaled)
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    lower = np.linalg.qr(root.T).R.T
    signs = np.where(np.diag(lower) < 0, -1.0, 1.0)
    return lower * signs * units[:, None]


Function = Callable[..., Any]


def takes_arguments_of(
    *definitions: Function, leaving_out: Collection[str] = (), defaults: Mapping[str, Any] | None = None
) -> Callable[[Function], Function]:
    """Return a decorator: a function of (self, **arguments) takes those of other functions, names and defaults.

    The function is called with all of them, and `inspect.signature` and `help` show them. A method's
    first argument may be given by position, the others by name; its own named arguments come last.

    Args:
        definitions: the functions that define the arguments; each argument in only one of them.
        leaving_out: excluded names.
        defaults: other defaults, by name.
    """
    changed = {} if defaults is None else defaults

    def decorate(function: Function) -> Function:
        own_parameters = inspect.signature(function).parameters.values()
        positional = [
            parameter for parameter in own_parameters if parameter.kind is parameter.POSITIONAL_OR_KEYWORD
        ]
        keyword_parameters = [
            parameter.replace(kind=parameter.KEYWORD_ONLY, default=changed.get(parameter.name, parameter.default))
            for definition in definitions
            for parameter in inspect.signature(definition).parameters.values()
            if parameter.name not in leaving_out
        ]
        if [parameter.name for parameter in positional] == ["self"]:
            keyword_parameters[0] = keyword_parameters[0].replace(kind=inspect.Parameter.POSITIONAL_OR_KEYWORD)
        by_name = [parameter for parameter in own_parameters if parameter.kind is parameter.KEYWORD_ONLY]
        signature = inspect.Signature([*positional, *keyword_parameters, *by_name])

        @wraps(function)
        def call(*positional_values, **named):
            try:
                bound = signature.bind(*positional_values, **named)
            except TypeError as error:
                raise TypeError(f"{function.__qualname__}() {error}") from None
            bound.apply_defaults()
            return function(**bound.arguments)

        decorated: Any = call
        decorated.__signature__ = signature
        return decorated

    return decorate


def arguments_of(definition: Function, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments by name that a function accepts."""
    known = inspect.signature(definition).parameters
    return {name: value for name, value in arguments.items() if name in known}


Part = TypeVar("Part")

_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener to progress", default=None)
_around: ContextVar[str] = ContextVar("progress of the work that this is a part of", default="")


@contextmanager
def listening(listener: Callable[[str], None]) -> Iterator[None]:
    """Within this context call listener("posterior bound: 40 of 200") as this thread's work proceeds."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)


def tell(text: str) -> None:
    """Report progress to the listener, if there is one."""
    listener = _listener.get()
    if listener is not None:
        listener(text)


def with_progress(what: str, parts: Sequence[Part], sizes: Sequence[int] | None = None) -> Iterator[Part]:
    """Iterate over the parts of a computation and report progress before each.

    Progress inside a part is appended to that of the part: "N = 40: 3 of 12, runs: 20 of 100".

    Args:
        what: name of what is computed.
        parts: what to go through; a single part is not reported.
        sizes: weight of each part in the count; 1 if None.
    """
    if _listener.get() is None or len(parts) < 2:
        yield from parts
        return
    sizes = [1] * len(parts) if sizes is None else sizes
    around, done = _around.get(), 0
    try:
        for part, size in zip(parts, sizes, strict=True):
            text = f"{around}{what}: {done} of {sum(sizes)}"
            _around.set(f"{text}, ")
            if (listener := _listener.get()) is not None:  # whoever listened may have stopped meanwhile
                listener(text)
            yield part
            done += size
    finally:
        _around.set(around)
