"""`LogProblem`: recorded runs, with or without true states, for filters that assume a model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from filters.consistency.time_constants import Run
from filters.starts import MEASUREMENT, STARTS, begun_at, cov_of_measured_starts, first_measured
from thruster_env.core.checks import at_least, one_of, short_repr
from thruster_env.core.streams import filter_keys
from thruster_env.env.model_env import ReplayEnv
from thruster_env.logs.columns import STATE
from thruster_env.logs.findings import OUTLIERS, Recording, has_outliers, remarks_on
from thruster_env.logs.findings import outliers as rows_of_outliers
from thruster_env.logs.log import RATIO, Log, in_any_steps, in_steps, seen_by
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.assumed import AssumedProblem, rows_of
from tuning.problems.check import check_quantities
from tuning.problems.data import Data, mask_of, only, padded
from tuning.problems.log_parts import Parts, check_apart, check_times, parts_of
from tuning.problems.problem import Parameter

ROBUST = ("ekf-robust",)  # filters that take measurements far from the prior for outliers

AT_GAPS = (
    "Runs are cut at gaps: no block has rows from both sides (--hold-gaps, hold_gaps=True, does not cut)",
    "At gaps the last input is held (--hold-gaps, in Python hold_gaps=True)",
)

ON_STAMPS = (
    "Logs are on their own stamps: Q of a step is in proportion to its length, and true states are not used."
)

KEPT, MISSING = OUTLIERS
OF_OUTLIERS = {
    KEPT: "Outliers raise R for all samples: --outliers missing (outliers='missing' in Python) leaves them out, "
    "--filter ekf-robust gives them less weight; or delete these samples from the log (an empty cell is a "
    "missing one).",
    MISSING: "Outliers are left out, as missing measurements (--outliers missing): a filter in use meets them, "
    "and needs a gate or less weight for them, as ekf-robust has.",
}

MEASURED = (
    "Each block begins where its first measurement says: the prior covariance is wide where a measurement sees "
    "the state."
)

QUATERNION = 3  # numbers of the error of a rotation, of which a pose's has more
ATTITUDES = "Each block begins at the attitude of its first measurement."


def unused_references(model: StateSpaceModel, logs: Sequence[Log]) -> list[str]:
    """Sentences on quaternions of all logs that are a part of a pose, whose other numbers no log has."""
    sentences = []
    for turn in model.turns:
        symbols = [state.symbol for state in turn.of_state(model.states)]
        known = [all(f"{STATE}:{symbol}" in log.references for log in logs) for symbol in symbols]
        if turn.size > QUATERNION and all(known[: QUATERNION + 1]):
            missing = ", ".join(symbol for symbol, is_known in zip(symbols, known, strict=True) if not is_known)
            sentences.append(
                f"The reference of {turn.name!r} is not used: an error of this state needs {missing}, too. "
                "thruster estimate states the errors of roll, pitch and yaw."
            )
    return sentences


def as_rows(log: Log) -> Log:
    """A log on its own stamps as one of rows with step ratios; true states and other references are left out."""
    inputs, measurements = in_steps(log)
    quantities = (*log.input_quantities, RATIO)
    fields: dict[str, Any] = {"inputs": inputs, "measurements": measurements, "input_quantities": quantities}
    fields |= {"references": {}, "referred": {}, "source": {}, "stamps": None, "recording": Recording()}
    return dataclasses.replace(log, **fields)


def checked_logs(user_logs: Any) -> tuple[Log, ...]:
    """Logs of one problem as a tuple; ValueError unless they have one sample time and different names."""
    logs = (
        (user_logs,) if isinstance(user_logs, Log) else tuple(user_logs) if isinstance(user_logs, Sequence) else ()
    )
    if not logs or not all(isinstance(log, Log) for log in logs):
        raise ValueError(f"logs must be some thruster_env.logs.log.Log, but got {short_repr(user_logs)}")
    check_times(logs)
    names = [log.name for log in logs]
    if len(set(names)) < len(names):
        raise ValueError(f"logs of one problem must have different names, but got {', '.join(names)}")
    return logs


class LogProblem(AssumedProblem):
    """Blocks of recorded runs as the data of a study; the seed of a block is its number.

    The problem decides which blocks are for training and which are held out, whatever the seed of the study: see
    `tuning.problems.log_parts`. A block has a lead-in that filters run through and that is not scored, and no gap:
    runs are cut there, and blocks with too few measurements are left out; `remarks` says so. A given number of
    blocks may differ in length, and each counts in full; where true states are known at some steps only, these
    are scored.

    Logs on their own stamps are rows with the step ratio as one more input (`thruster_env.logs.log`), without
    true states, and a tuned file is for the model of a step of dt.

    Without true states there is no scale, and the negative log-likelihood of the innovations is minimised. The
    rule of thumb has the R of the model.

    Args:
        logs: recorded runs with the same sample time, with the model's inputs and measurements.
        assumed: the model that filters assume, or a function of `parameters` that makes it.
        lead: steps of a lead-in; 50 if None, of short logs fewer.
        blocks: number of blocks of each run; if None there are about 72 of one length in all.
        hold_gaps: whether runs are not cut at gaps, and their inputs are held there.
        outliers: whether samples that the logs' findings call outliers are "kept" or "missing".
        start: where blocks begin: "prior", as the model's prior says, or "measurement", where their first
            measurement does (`filters.starts.cov_of_measured_starts`), the prior elsewhere. If None it is the
            prior, but for ekf-robust: most blocks begin in the middle of a run, where the prior is off, and that
            filter would take their first measurements for outliers.
        held_out: names of the held-out runs; if None every third run, or every third block of fewer than three
            runs.
        truth: whether the logs' true states are used, if each log has all of them, at some steps at least.
        shortest: scored rows that a block must have; 25 if None, of short logs fewer.
        apart: whether it is an error that a held-out run has rows in common with another one.
        content: the options that make the problem, as data for JSON; commands store theirs there.
        scale, parameters, untuned, name, about: those of `AssumedProblem`; the scale is by default the standard
            deviation of each true state.

    Raises:
        ValueError: states the rule and the value.
    """

    seed_word = "blocks"

    def __init__(
        self,
        logs: Log | Sequence[Log],
        assumed: StateSpaceModel | Callable[..., StateSpaceModel],
        *,
        lead: int | None = None,
        blocks: int | None = None,
        hold_gaps: bool = False,
        outliers: str = KEPT,
        start: str | None = None,
        held_out: Collection[str] | None = None,
        truth: bool = True,
        apart: bool = True,
        shortest: int | None = None,
        content: Mapping | None = None,
        scale: Sequence[float] | None = None,
        parameters: Sequence[Parameter] | None = None,
        untuned: Mapping | None = None,
        name: str | None = None,
        about: str = "",
    ):
        """Cut the logs into blocks; see the class for the arguments."""
        self.recorded = self.logs = checked_logs(logs)
        self._in_steps = self.logs[0].stamps is not None
        self._outliers = one_of("outliers", outliers, OUTLIERS)
        if outliers == MISSING:
            self.logs = tuple(map(without_outliers, self.recorded))
        if self._in_steps:
            self.logs = tuple(map(as_rows, self.logs))
        self._start, self._first = None if start is None else one_of("start", start, STARTS), None
        cut = partial(
            parts_of, self.logs, lead, blocks, held_out, hold_gaps=hold_gaps, sizes=True, shortest=shortest
        )
        self.parts: Parts = cut()
        self._holds = hold_gaps
        proving = {self.parts.blocks[index].run for index in self.parts.held_out}
        learning = {self.parts.blocks[index].run for index in (*self.parts.training, *self.parts.sizes)} - proving
        if apart:
            check_apart([self.logs[run] for run in sorted(learning)], [self.logs[run] for run in sorted(proving)])
        self._content = content
        super().__init__(
            assumed,
            steps=max(block.rows for block in self.parts.blocks) - 1,
            first_scored_step=self.parts.lead,
            scale=scale,
            parameters=parameters,
            untuned=untuned,
            true=None,
            dt=self.logs[0].dt,
            name=_name(self.logs) if name is None else name,
            about=about,
        )
        model = self.model()
        for log in self.logs:
            check_quantities("input", log.input_quantities, model.input_quantities, f"log {log.name}", "the model")
            check_quantities("measurement", log.measured, model.measurements, f"log {log.name}", "the model")
        by_log = [log.true_states(model) if truth else None for log in self.logs]
        known = [states for states in by_log if states is not None]
        self._states = known if len(known) == len(by_log) else None
        if self._states is None and self._scale is not None:
            raise ValueError(f"a scale must come with logs of all true states, but {self.name} lacks them")
        if self._states is not None:
            rows = [~np.isnan(states).any(axis=1) for states in self._states]
            self.parts = cut(known=rows)
            self.first_scored_step, self.steps = (
                self.parts.lead,
                max(block.rows for block in self.parts.blocks) - 1,
            )
        if start == MEASUREMENT:
            self._first = first_measured(self.data(self.parts.training).seen.measurements)
            self.model()  # an error on a start that nothing sees

    @property
    def origin(self) -> tuple:
        """The logs by their samples, and their blocks."""
        parts = self.parts.blocks, len(self.parts.training), self._states is None, self._start == MEASUREMENT
        return tuple(log.digest for log in self.logs), *parts

    @property
    def remarks(self) -> tuple[str, ...]:
        """Findings in the logs, and their rows that are in no block."""
        remarks = remarks_on(self.recorded)
        if has_outliers(self.recorded):
            remarks.append(OF_OUTLIERS[self._outliers])
        if self._in_steps:
            remarks.append(ON_STAMPS)
        if any(len(log.pieces) > 1 for log in self.logs):
            remarks.append(f"{AT_GAPS[self._holds]}.")
        if self._start == MEASUREMENT:
            remarks.append(MEASURED)
        if self.model().turns:
            remarks.append(ATTITUDES)
        if self._states is None:
            remarks += unused_references(self.model(), self.logs)
        return (*remarks, *self.parts.sentences())

    def model(self, **changes) -> StateSpaceModel:
        """The assumed model with some changes, and with the prior covariance of the start."""
        model = self._of_dt(**changes)
        return in_any_steps(model, self.logs[0].dt) if self._in_steps else model

    def _of_dt(self, **changes) -> StateSpaceModel:
        """The same for a step of the sample time."""
        model = super().model(**changes)
        if self._first is None:
            return model
        return model.replace(prior_cov=cov_of_measured_starts(model, self._first))

    def started_for(self, name: str, model: StateSpaceModel) -> StateSpaceModel:
        """The model with a prior that is wide where a measurement sees it, for `ROBUST` filters; see the class."""
        if name not in ROBUST or self._start is not None:
            return model
        first = first_measured(self.data(self.parts.training).seen.measurements)
        try:
            return model.replace(prior_cov=cov_of_measured_starts(model, first))
        except ValueError:  # no measurement sees a state at the prior mean
            return model

    def training_seeds(self, seed: int, count: int) -> range:
        """Numbers of all training blocks, for any count."""
        return self.parts.training

    def size_seeds(self, seed: int, count: int) -> range:
        """Numbers of the blocks set aside for the choice at the end; the training blocks where there are none."""
        return self.parts.sizes or self.parts.training

    def validation_seeds(self, seed: int, count: int) -> range:
        """Numbers of the blocks on which the best trials meet the baselines: those of `size_seeds`."""
        return self.size_seeds(seed, count)

    def held_out_seeds(self, seed: int, count: int) -> range:
        """Numbers of all held-out blocks, for any count."""
        return self.parts.held_out

    def long_runs(self, seed: int) -> list[Run]:
        """The two longest logs with training blocks, whole, or between gaps where runs are cut at these."""
        training = {self.parts.blocks[index].run for index in (*self.parts.training, *self.parts.sizes)}
        pieces = {run: max(self._pieces(run), key=lambda piece: piece[1]) for run in sorted(training)}
        longest = sorted(pieces, key=lambda run: -pieces[run][1])[:2]
        runs = []
        for run in longest:
            log, (first, rows) = self.logs[run], pieces[run]
            inputs = log.inputs[first : first + rows - 1]
            measurements = seen_by(self.model(), log.measurements[first : first + rows])
            runs.append((filter_keys((run,)), inputs[None], measurements[None]))
        return runs

    def _pieces(self, run: int) -> tuple[tuple[int, int], ...]:
        """First row and number of rows of the parts of a log that filters run through without a cut."""
        log = self.logs[run]
        return ((0, log.steps + 1),) if self._holds else log.pieces

    @property
    def shortest_log(self) -> int:
        """Number of steps of the shortest of the logs."""
        return min(log.steps for log in self.logs)

    def logs_of(self, seeds: Sequence[int]) -> np.ndarray:
        """The number of each block's log: neighbouring blocks of one log depend on each other."""
        return np.array([self.parts.blocks[seed].run for seed in seeds])

    @property
    def log_names(self) -> tuple[str, ...]:
        """The names of the logs."""
        return tuple(log.name for log in self.logs)

    def run_label(self, seed: int) -> str:
        """The log of a block, and the times of its scored rows by the log's own clock."""
        block = self.parts.blocks[seed]
        return self.span_label(block.run, block.first + self.parts.lead, block.first + block.rows - 1)

    def span_label(self, run: int, first: int, last: int) -> str:
        """A log by its number, and the times of two of its rows by the log's own clock."""
        log, times = self.recorded[run], self.recorded[run].times
        if self._in_steps:  # whose rows have step ratios, and may stand between two stamps
            times = log.dt * np.append(0.0, np.cumsum(self.logs[run].inputs[:, -1]))
        start, end = (log.start + times[row] for row in (first, last))
        return f"{log.name} from {start:.6g} to {end:.6g} s"

    @property
    def range_seeds(self) -> range:
        """Blocks whose runs determine each state's range."""
        return self.parts.training

    @property
    def counts_start_up(self) -> bool:
        """Whether the first steps are scored: they are not, since most blocks begin in the middle of a run."""
        return False

    @property
    def leads_in(self) -> bool:
        """Whether the first steps are a lead-in: they are, since the prior belongs to a run's start."""
        return True

    def make(self, seeds: tuple[int, ...]) -> Data:
        """Blocks of these numbers."""
        known = len(self.parts.blocks)
        wrong = [seed for seed in seeds if not 0 <= seed < known]
        if wrong:
            raise ValueError(
                f"blocks of problem {self.name} must be numbered 0 to {known - 1}, but got {wrong[0]}"
            )
        model, rows, blocks = self.model(), self.steps + 1, [self.parts.blocks[seed] for seed in seeds]
        slices = [(block.run, slice(block.first, block.first + block.rows)) for block in blocks]
        inputs = padded([self.logs[run].inputs[part][: rows - 1] for run, part in slices], rows - 1, None)
        measured = [seen_by(model, self.logs[run].measurements[part]) for run, part in slices]
        measurements = padded(measured, rows)
        counted = mask_of([block.rows for block in blocks], rows)
        data = Data(seeds, inputs, measurements, filter_keys(seeds), self.first_scored_step, counted=counted)
        if model.turns:
            data = data._replace(begun=begun_at(model, first_measured(measurements)))
        if self._states is None:
            return data
        states = padded([self._states[run][part] for run, part in slices], rows)
        is_full = states.shape[-1] == model.n
        outputs = {symbol: model.output(symbol, states) for symbol in model.outputs} if is_full else {}
        counted = only(counted, ~np.isnan(states).any(axis=-1))
        return data._replace(states=states, outputs=outputs, counted=counted)

    def make_env(self, *, run: int = 0, **arguments: Any) -> ReplayEnv:
        """A recorded run as an env that replays it, ignoring the action, and offers filters the assumed model.

        Args:
            run: place of the run among the logs.
            **arguments: none.
        """
        if arguments:
            raise ValueError(f"an env of recorded runs must come with run alone, but got {', '.join(arguments)}")
        return ReplayEnv(self.recorded[at_least("run", run, 0, len(self.logs) - 1)], self._of_dt)

    def found_scale(self) -> np.ndarray:
        """The standard deviation of each true state over the scored steps of the training blocks."""
        data = self.data(self.parts.training)
        scale = rows_of(data.scored_rows(data.known_states), self.model()).std(axis=0)
        if not (scale > 0).all():
            raise ValueError(
                f"the scale of problem {self.name} must be given where a state does not move, "
                f"but its true states have the standard deviations {scale.tolist()}"
            )
        return scale

    def as_mapping(self) -> Mapping | None:
        """The logs by path and digest, with the options of the problem; None without options."""
        if self._content is None:
            return None
        return {"logs": [{"file": log.name, "digest": log.digest} for log in self.logs], **self._content}


def without_outliers(log: Log) -> Log:
    """The log with the samples that its findings call outliers as missing ones."""
    measurements = log.measurements.copy()
    for column, quantity in enumerate(log.measured):
        measurements[rows_of_outliers(log, f"measurement:{quantity.symbol}"), column] = np.nan
    return replace(log, measurements=measurements)


def _name(logs: Sequence[Log]) -> str:
    """What logs are called together: the first one's name, and how many there are more."""
    more = f" and {len(logs) - 1} more" if len(logs) > 1 else ""
    return f"{logs[0].name}{more}"
