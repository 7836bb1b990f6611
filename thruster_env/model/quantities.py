"""Quantities of a model: names, symbols and units of its vectors, positions, bounds and scales of its states."""

from __future__ import annotations

import math
import unicodedata
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import as_floats, short_repr
from thruster_env.core.sources import as_value

LONG = 60  # characters of a name that an axis has room for


class Quantity(NamedTuple):
    """One component of a vector.

    Attributes:
        name: in words, such as "motor speed".
        symbol: as in equations and file headers, such as "omega_m"; letters, digits, "_" and "-".
        unit: SI unit, such as "rad/s"; empty for a pure number.
        angle: whether it is an angle that wraps at 2 pi [rad]: filters and scores wrap its differences to (-pi,
            pi].
    """

    name: str
    symbol: str
    unit: str = ""
    angle: bool = False

    @property
    def label(self) -> str:
        """Name and unit, for tables."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def short_label(self) -> str:
        """Symbol and unit, for columns of tables and of files."""
        return f"{self.symbol} [{self.unit}]" if self.unit else self.symbol

    @property
    def text_symbol(self) -> str:
        """The symbol with Greek letters, for pages: omega_m is "ω_m"."""
        letter, underscore, index = self.symbol.partition("_")
        return (_greek(letter) or letter) + underscore + index

    @property
    def plot_label(self) -> str:
        """Name, symbol and unit, for axes of figures."""
        from thruster_env.core.text_tables import verbatim  # which imports rich

        symbol = "" if self.symbol == self.name else f" ${_mathtext(self.symbol)}$"
        return f"{verbatim(self.name, most=LONG)}{symbol}" + (f" [{verbatim(self.unit)}]" if self.unit else "")


class Output(NamedTuple):
    """An output of a model: a quantity y = function(x, c) of the state x and the model's constants c.

    The function uses operators on the components of x only, so that it takes arrays as well as floats.
    """

    quantity: Quantity
    function: Callable


class Quantities(NamedTuple):
    """The components of a model's vectors, named as its fields are."""

    states: tuple[Quantity, ...]
    input_quantities: tuple[Quantity, ...]
    measurements: tuple[Quantity, ...]


def count_of(names: Any) -> int:
    """The number of components for some quantities or names; one if they are no list."""
    return len(names) if _are_several(names) else 1


def quantities(kind: str, named: Any, count: int, letter: str, counted: str) -> tuple[Quantity, ...]:
    """Make quantities from `Quantity` values, tuples of their fields, or names; letter_1, letter_2, ... if None.

    Args:
        kind: their kind, for messages: "states".
        named: a sequence with `count` entries, or None.
        count: number of components.
        letter: default symbol of components without names.
        counted: the argument that defines their number, for messages: "prior_mean".

    Raises:
        ValueError: if there are not `count` of them, symbols are equal, or a name, symbol, unit or angle is wrong.
    """
    if named is None:
        return tuple(Quantity(f"{letter}_{i}", f"{letter}_{i}") for i in range(1, count + 1))
    if not _are_several(named) or len(named) != count:
        raise ValueError(
            f"{kind} must be {count} quantities or names, as {counted} says, but got {short_repr(named)}"
        )
    checked = tuple(_quantity(kind, entry) for entry in named)
    symbols = [quantity.symbol for quantity in checked]
    if len(set(symbols)) < count:
        raise ValueError(f"symbols of {kind} must differ from one another, but got {', '.join(symbols)}")
    return checked


def _are_several(names: Any) -> bool:
    return isinstance(names, Sequence) and not isinstance(names, str)


def _quantity(kind: str, entry) -> Quantity:
    try:
        quantity = Quantity(entry, entry.replace(" ", "_")) if isinstance(entry, str) else Quantity(*entry)
    except TypeError:
        quantity = None
    if quantity is None or not _is_valid(quantity):
        rule = f"each of {kind} must be a name, or have name, symbol (letters, digits, _ and -), unit and angle"
        raise ValueError(f"{rule}, and an angle the unit rad, but got {short_repr(entry)}")
    return quantity


def _is_valid(quantity: Quantity) -> bool:
    texts = all(isinstance(text, str) for text in quantity[:3]) and isinstance(quantity.angle, bool)
    plain = texts and quantity.symbol.replace("_", "").replace("-", "").isalnum()
    return plain and (not quantity.angle or quantity.unit == "rad")


def outputs(mapping: Mapping[str, Output | Sequence]) -> dict[str, Output]:
    """Outputs by symbol, each an `Output` or (quantity, function); ValueError states the rule and the value."""
    if not isinstance(mapping, Mapping):
        raise ValueError(f"outputs must map symbols to quantities and functions, but got {short_repr(mapping)}")
    checked = {}
    for symbol, output in mapping.items():
        if not isinstance(output, Sequence) or len(output) != 2 or not callable(output[1]):
            raise ValueError(
                f"the output {symbol!r} must be a quantity and a function, but got {short_repr(output)}"
            )
        checked[symbol] = Output(_quantity(f"outputs, {symbol}", output[0]), output[1])
    return checked


_GREEK = {
    *("alpha", "beta", "gamma", "delta", "epsilon", "theta", "kappa", "lambda", "mu", "nu", "xi", "rho", "sigma"),
    *("tau", "phi", "chi", "psi", "omega", "eta", "zeta"),
}


def _greek(name: str) -> str | None:
    """The Greek letter of a name such as "omega" or "Omega"; None if it is none."""
    if name.lower() not in _GREEK:
        return None
    size = "CAPITAL" if name[0].isupper() else "SMALL"
    return unicodedata.lookup(f"GREEK {size} LETTER {name.upper().replace('LAMBDA', 'LAMDA')}")


def _mathtext(symbol: str) -> str:
    """A symbol as matplotlib reads it, Greek letters by name."""
    letter, *indices = symbol.split("_")
    letter = f"\\{letter}" if letter.lower() in _GREEK else letter if len(letter) == 1 else f"\\mathrm{{{letter}}}"
    return letter + (f"_{{{','.join(indices)}}}" if indices else "")


class Positions(NamedTuple):
    """Positions of n states and m measurements, in any unit.

    Attributes:
        states: (n, d), or (n,) along a line.
        measurements: (m, d), or (m,).
        period: of each coordinate, (d,), after which space begins again; infinite, or None for all, without.
    """

    states: Any
    measurements: Any
    period: Any = None

    def checked(self, n: int, m: int) -> Positions:
        """The same as arrays, for so many states and measurements; ValueError if shapes do not fit."""
        states, measurements = (as_floats(part) for part in self[:2])
        states, measurements = (part[:, None] if part.ndim == 1 else part for part in (states, measurements))
        for name, part, count in (("states", states, n), ("measurements", measurements, m)):
            if part.shape != (count, states.shape[-1]) or not np.isfinite(part).all():
                rule = f"({count}, {states.shape[-1]}) finite numbers"
                raise ValueError(f"positions of {name} must be {rule}, but got {short_repr(getattr(self, name))}")
        period = np.full(states.shape[1], np.inf) if self.period is None else as_floats(np.atleast_1d(self.period))
        if period.shape != states.shape[1:] or not (period > 0).all():
            raise ValueError(
                f"period must be {states.shape[1]} positive numbers, but got {short_repr(self.period)}"
            )
        return Positions(states, measurements, period)

    def distances(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Euclidean distances, the short way round, between positions (k, d) and (l, d), (k, l)."""
        apart = abs(first[:, None] - second) % self.period
        return np.linalg.norm(np.minimum(apart, self.period - apart), axis=-1)


class Bound(NamedTuple):
    """The smallest and the largest value that a state, by its index, can have; infinite where there is none."""

    place: int
    low: float
    high: float


def checked_bounds(user_bounds: Any, states: Sequence[Quantity], rotations: Any = ()) -> tuple[Bound, ...]:
    """Bounds in the order of the states, from a mapping of symbols or indices to pairs; None is no bound.

    Raises ValueError for another state, an angle, or a pair that is not increasing numbers.
    """
    if not isinstance(user_bounds, Mapping):  # those of another model
        user_bounds = {bound[0]: bound[1:] for bound in user_bounds}
    if rotations and user_bounds:
        raise ValueError(f"a model with rotations must have no bounds, but got {short_repr(user_bounds)}")
    symbols, result = [state.symbol for state in states], []
    for name, pair in user_bounds.items():
        index = symbols.index(name) if name in symbols else name
        if not isinstance(index, int) or not 0 <= index < len(states) or states[index].angle:
            known = ", ".join(state.symbol for state in states if not state.angle)
            raise ValueError(f"bounds must be of states {known}, and not of angles, but got {short_repr(name)}")
        try:
            low, high = pair
            low, high = (-math.inf if low is None else float(low)), (math.inf if high is None else float(high))
        except (TypeError, ValueError):
            low = high = math.nan
        if not low < high or low == math.inf or high == -math.inf:
            rule = f"bounds of {symbols[index]} must be two increasing numbers, of which one may be None"
            raise ValueError(f"{rule}, but got {short_repr(pair)}")
        if low > -math.inf or high < math.inf:
            result.append(Bound(index, low, high))
    return tuple(sorted(result))


def scales_of(model) -> np.ndarray:
    """Scale of each state of a model, (n,): its standard deviation in prior and Q together.

    For a state without both, such as a position whose velocity is uncertain, it is how far states of known scale
    move it in a step; else how far it moves by itself, or its prior mean's magnitude, or 1. So results do not
    depend on units.
    """
    scales = np.sqrt(np.diag(model.prior_cov) + np.diag(model.process_noise_cov))
    if model.turns:
        from thruster_env.model.turns import stored_of  # which imports this module

        scales = np.array(stored_of(scales, model.turns, 1.0))
    if (scales > 0.0).all():
        return scales
    start = _propagated(model, model.prior_mean)
    shares = 0.75 + 0.25 * np.cos(np.arange(model.n))  # unequal, so that no two changes cancel
    for _ in range(model.n):
        reached = _sizes(_propagated(model, model.prior_mean + shares * scales) - start)
        if not ((scales == 0.0) & (reached > 0.0)).any():
            break
        scales = np.where(scales > 0.0, scales, reached)
    for other in (_sizes(start - model.prior_mean), abs(model.prior_mean), np.ones(model.n)):
        scales = np.where(scales > 0.0, scales, other)
    return scales


def _sizes(changes: np.ndarray) -> np.ndarray:
    """Magnitudes of finite changes, and 0 for others."""
    return np.where(np.isfinite(changes), abs(changes), 0.0)


def _propagated(model, x: np.ndarray) -> np.ndarray:
    """The state after x with inputs of zero, as Python has it; NaN where there is none."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            u = as_value([0.0] * model.inputs)
            propagated = as_floats(model.transition(as_value(x.tolist()), u, model.given_constants))
    except Exception:  # whatever a user's function raises; `model_check` says what is wrong
        return np.full(model.n, np.nan)
    return propagated if propagated.shape == x.shape else np.full(model.n, np.nan)
