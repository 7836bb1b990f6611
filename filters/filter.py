"""The interface of a filter: `init`, `predict(belief, u)`, `update(belief, z)`, all pure functions.

A filter is a frozen value that holds a model and its own tunable parameters. Each filter type supplies three plain
functions that work in place on one row of floats and one table of members (`Kernels`); everything else,
single steps and whole batches, compiled or not, is made from these in `filters.engine.compile`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from filters.engine.belief import Belief, Innovation, Kernels, OwnBelief, bounded_kernels
from filters.engine.compile import PREDICT, UPDATE
from filters.engine.session import GatedSession, Running, Session
from filters.pages.kernels import page_kernels
from filters.pages.page import Page
from thruster_env.core.checks import short_repr
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.modules import object_named
from thruster_env.logs.log import in_steps_of, sample_time_of
from thruster_env.model.state_space import StateSpaceModel

if TYPE_CHECKING:
    from filters.live import Live


Q, R = "Q", "R"
LIVE = "filters.live:Live"  # which knows this module
SPARE, SPARE_IN_PYTHON = "_spare", "_spare_in_python"  # attributes: sessions that are not in use


@dataclass(frozen=True, kw_only=True, eq=False)
class Filter:
    """Base of all filters; subclasses add their tunable parameters and the method `kernels`.

    Attributes:
        model: the `StateSpaceModel` that the filter assumes.
    """

    name: ClassVar[str]
    varying_noise: ClassVar[bool] = True  # whether both Q and R may differ from step to step: see `fixed_noise`
    has_covariance: ClassVar[bool] = True  # if not, covariances and log-likelihoods are zero and say nothing
    one_model: ClassVar[bool] = True  # if not, it has others beside `model`, with their own sample times and Q
    mixable: ClassVar[bool] = True  # whether a step may begin with another mean and P than those the last one left
    any_step: ClassVar[bool] = True  # whether it multiplies Q by the step ratio of `thruster_env.logs.log`
    by_length: ClassVar[bool] = False  # whether steps of another length have the numbers of `of_length`
    gaussian_likelihood: ClassVar[bool] = True  # whether the log-likelihood is that of N(innovation; 0, S)
    model: StateSpaceModel

    def kernels(self) -> Kernels:
        """The plain functions of this filter type for the shape of its model."""
        raise TypeError(f"{type(self).__name__} has no kernels: use one of its subclasses")

    @property
    def kernel_model(self) -> StateSpaceModel:
        """The model whose functions and numbers the kernels use: the given one, unless a filter replaces it."""
        return self.model

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The filter's own parameters, packed behind the model's: from `belief.filter_offset` on."""
        return ()

    @property
    def numbers(self) -> np.ndarray:
        """Packed parameters that the kernels read, one float64 row: the model's, then the filter's own."""
        return np.append(self.kernel_model.numbers, self.own_parameters)

    @property
    def size(self) -> int:
        """Number of ensemble members; 0 for filters without an ensemble."""
        return 0

    def init(self, key: tuple[int, int] = (0, 0)) -> Belief:
        """The prior as a belief; key, two integers from 0 to 2^32 - 1, determines its random draws.

        Raises ValueError for another key.
        """
        session = self._borrow()
        session.read_functions()
        session.set_key(key)
        session.run("start")
        belief = session.belief()
        self._put_back(session)
        return belief

    def predict(self, belief: Belief, u, *, process_noise_cov=None) -> Belief:
        """Predict the belief one step ahead under input u (p,), in the units of the model's inputs.

        A `process_noise_cov`, (n, n) or n variances per step, replaces the model's Q in this step. A result that
        is not finite is a `LostBelief`: the next update restarts from the prior and counts that.

        Raises ValueError for an input that is not p finite numbers, and for a belief of another filter type, not
        finite, or with a covariance that is not positive semidefinite.
        """
        if process_noise_cov is None and type(belief) is OwnBelief:
            result = self._quickly(belief, PREDICT, u)
            if result is not None:
                return result
        session = self._borrow()
        session.load(belief)
        if process_noise_cov is not None:
            session.set_noise(process_noise_cov=process_noise_cov)
        session.run("predict", u=u)
        predicted = session.belief()
        self._put_back(session)
        return predicted

    def update(self, belief: Belief, z, *, u=None, measurement_noise_cov=None) -> tuple[Belief, Innovation]:
        """Update the belief with measurement z (m,); return it and the innovation. NaN marks a missing channel.

        A `measurement_noise_cov`, (m, m) or m variances, replaces the model's R in this update. If the model's h
        takes the input, it gets that of the last `predict`, zero before the first one, or `u` (p,) if that is not
        None. So z_k = h(x_k, u_k), of the input from k on, is `update(belief, z, u=u)`, then `predict(belief, u)`.

        Raises ValueError for a measurement that is not m numbers, finite or NaN, an input that h does not take or
        that is not p finite numbers, and as `predict` for a belief.
        """
        if u is None and measurement_noise_cov is None and type(belief) is OwnBelief:
            result = self._quickly(belief, UPDATE, z)
            if result is not None:
                return result
        session = self._borrow()
        session.load(belief)
        if measurement_noise_cov is not None:
            session.set_noise(measurement_noise_cov=measurement_noise_cov)
        if u is not None:
            session.set_input(u)
        session.run("update", z=z)
        updated = session.belief(), session.innovation_copy()
        self._put_back(session)
        return updated

    def sample(self, belief: Belief) -> np.ndarray:
        """Members that stand for a belief, (n, N); where they have weights, a row behind holds the logarithms."""
        return belief.members[: self.kernel_model.n + 1]

    def _quickly(self, belief: OwnBelief, task: int, signal) -> Any:
        """The result of a prediction, or of an update, by a spare session; None without one, or if it refuses."""
        spare = self._spare_sessions()
        try:
            session = spare.pop()  # then no other thread has it
        except IndexError:
            return None
        result = session.quickly(belief, task, signal)
        if not spare:
            spare.append(session)
        return result

    def _borrow(self) -> Session:
        """A spare session in its initial state, else a new one, which takes longer to make than a step.

        `_put_back` returns it, except after an error.
        """
        try:
            session = self._spare_sessions().pop()
            if session.is_current:
                session.clear()
                return session
        except IndexError:
            pass
        return Session(self)

    def _put_back(self, session: Session) -> None:
        spare = self._spare_sessions()
        if not spare:
            spare.append(session)

    def _spare_sessions(self) -> list:
        """Sessions that are not in use: at most one, unless several threads put theirs back at once."""
        attributes = vars(self)
        name = SPARE_IN_PYTHON if is_interpreting() else SPARE
        return attributes.get(name) or attributes.setdefault(name, [])

    def __getstate__(self) -> dict:
        """The fields, without memory that is kept for the next call."""
        return {name: value for name, value in vars(self).items() if name not in (SPARE, SPARE_IN_PYTHON)}

    @classmethod
    def of_recursion(cls) -> type[Filter]:
        """The class whose recursion it has: its own, or that of which it only has another start."""
        return cls

    def from_first_input(self, inputs: Any, rows: int, update_first: bool) -> tuple[Filter, Any]:
        """The filter and the inputs of a run of so many rows, of those that the user gave."""
        return self, inputs

    @property
    def sample_time(self) -> float:
        """The sample time of its model [s]; ValueError for a model in which it is no constant."""
        return sample_time_of(self.model, f"steps of any length of {self.name!r}")

    def of_length(self, length: float) -> Self:
        """The filter for steps of another length [s], with Q in proportion to it."""
        model = in_steps_of(self.model, length)
        return self if model is self.model else dataclasses.replace(self, model=model)

    @property
    def fixed_noise(self) -> tuple[str, ...]:
        """Which of Q and R this filter reads when it is made or started only: these must not vary."""
        return () if self.varying_noise else (Q, R)

    def check_noise(self, process_noise_cov=None, measurement_noise_cov=None) -> None:
        """Raise ValueError for covariances of one step or of several that the filter cannot take."""
        for name, value in ((Q, process_noise_cov), (R, measurement_noise_cov)):
            if value is not None and name in self.fixed_noise:
                raise ValueError(
                    f"{' and '.join(self.fixed_noise)} of the filter {self.name!r} cannot vary from step to step, "
                    f"but got another {name}: make the filter for a model with it"
                )

    def session(self, gate: float | None = None, most: int | None = None) -> Running:
        """A session: this filter running in place on one belief, some ten times as fast as `predict` and `update`.

            session.start()
            session.predict(u)
            session.update(z)
            session.mean, session.cov

        With a gate, a channel whose innovation is beyond so many standard deviations of S is left out of a step,
        as if it were missing; `rejected` counts these, (m,). After `most` in a row, the next ones count
        until one is within the gate again, as the channel has jumped.

        Raises ValueError for a gate that is not a positive number, or `most` below 1.
        """
        return Session(self) if gate is None else GatedSession(self, gate, most)

    def live(self, **options: Any) -> Live:
        """This filter on real clocks, with steps of any length and each sensor at its own times; see `Live`."""
        return object_named(LIVE, "class")(self, **options)


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
        for name, value in self.parameters.items():
            if np.isnan(value).any():
                raise ValueError(f"{name} of {self.name} must be a number, but got {short_repr(value)}")
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
        takes_rotations: whether its page is written with the steps of a state that has rotations.
    """

    forms: ClassVar[Mapping[str, Page]] = {}
    takes_rotations: ClassVar[bool] = False

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
        model = self.kernel_model
        shape = model.any_shape if self.takes_rotations else model.shape
        plain = page_kernels(self.written_page, model.functions, shape)
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
