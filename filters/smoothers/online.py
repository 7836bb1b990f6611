"""The fixed-lag smoother of a running filter: the state some steps ago, given all measurements up to now."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from filters.engine.batch import Beliefs
from filters.engine.session import Session
from filters.filter import Filter
from filters.pages.page_filter import PageFilter
from filters.smoothers.points import relation_of
from filters.smoothers.rts import passes
from thruster_env.core.checks import at_least


class WithSmoother:
    """A session, or the beliefs of all copies, that also estimates the state `lag` steps ago.

    After step k this is x_{max(k - lag, 0)} given the measurements up to k, in the first steps the initial state.
    The last lag + 1 estimates of the filter are kept, and each step makes one pass of the smoother of Rauch, Tung
    and Striebel over them. So the results equal those of `filters.smooth` with the same lag, at about `lag` times
    the cost of a filter step. Each step keeps the dt and Q that the session had.

    Source: Anderson, Moore (1979), Optimal Filtering, chapter 7, for the fixed lag.
    """

    def __init__(self, runs: Session | Beliefs, filter_: Filter, lag: int, count: int = 1):
        """Take the session or the beliefs, their filter and the lag, a whole number; `start` comes next.

        Raises ValueError for another lag, and a filter without a smoother of this kind.
        """
        self._runs, self._lag = runs, at_least("smoothing_lag", lag, 0)
        self._relation = relation_of(filter_, "a smoothing_lag")
        assert isinstance(filter_, PageFilter)
        self._filter = filter_
        n, model = filter_.model.n, filter_.kernel_model
        self._means, self._covs = np.zeros((count, lag + 1, n)), np.zeros((count, lag + 1, n, n))
        self._restarted = np.zeros((count, lag + 1), dtype=bool)
        self._inputs, self._age = np.zeros((count, lag, model.inputs)), np.zeros(count, dtype=int)
        self._numbers = self._first_numbers(lag)
        self._divergences = np.zeros(count)
        self._passes: Callable | None = None

    def __getstate__(self) -> dict:
        """All attributes except machine code, which is looked up again."""
        return vars(self) | {"_passes": None}

    def __setstate__(self, state: dict) -> None:
        vars(self).update(state)

    def __getattr__(self, name: str):
        """Return other attributes, such as the estimate, of the session or the beliefs."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._runs, name)

    def start(self, *arguments) -> None:
        """Start with a key and a measurement, or copies (which, keys, measurements)."""
        self._runs.start(*arguments)
        which = arguments[0] if len(arguments) == 3 else slice(None)
        mean, cov, divergences = self._estimate()
        # Earlier steps are not used; they get the first estimate, at which the model can be evaluated.
        self._means[which], self._covs[which] = mean[which, None], cov[which, None]
        self._inputs[which], self._restarted[which], self._age[which] = 0.0, False, 0
        self._divergences[which] = divergences[which]
        self._numbers = self._first_numbers(self._lag)

    def step(self, u, z, idle: np.ndarray | None = None) -> None:
        """Predict with u and update with z; NaN marks a missing channel."""
        self._runs.step(u, z, **({} if idle is None else {"idle": idle}))
        mean, cov, divergences = self._estimate()
        newest = (self._means, mean), (self._covs, cov), (self._restarted, divergences > self._divergences)
        for history, new in (*newest, (self._inputs, np.reshape(u, (len(mean), -1)))):
            if history.shape[1]:
                history[:, :-1] = history[:, 1:]
                history[:, -1] = new
        if isinstance(self._runs, Session) and len(self._numbers):
            self._numbers[:-1] = self._numbers[1:]
            self._numbers[-1] = self._runs.numbers
        self._divergences, self._age = divergences, np.minimum(self._age + 1, self._lag)

    def smoothed(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n,) and covariance (n, n) of the state `lag` steps ago; for copies with a row for each."""
        if self._passes is None:
            self._passes = passes(self._filter, self._relation)
        estimates = self._means, self._covs, self._restarted
        oldest = np.arange(len(self._age)), self._lag - self._age
        means, covs = (part[oldest] for part in self._passes(estimates, self._inputs, self._lag, self._numbers))
        return (means[0], covs[0]) if isinstance(self._runs, Session) else (means, covs)

    def _first_numbers(self, lag: int) -> np.ndarray:
        """The filter's numbers; for a session, which may change them, a row for each step."""
        return np.repeat(self._filter.numbers[None], lag if isinstance(self._runs, Session) else 1, axis=0)

    def _estimate(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        runs = self._runs
        if isinstance(runs, Session):
            return runs.mean[None], runs.cov[None], np.array([float(runs.divergences)])
        n = self._means.shape[2]
        return runs.part("mean", n), runs.part("cov", n, n), runs.part("divergences")
