"""`LogProblem`: recorded runs, with or without true states, for filters that assume a model."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from numerics.checks import at_least, shown
from numerics.streams import filter_keys
from plants.logs.log import Log
from plants.replay import ReplayEnv
from plants.state_space import StateSpaceModel
from tuning.problems.assumed import AssumedProblem, rows_of
from tuning.problems.check import check_quantities
from tuning.problems.data import Data
from tuning.problems.digest import digest_of
from tuning.problems.log_parts import LEAD, Parts, parts_of
from tuning.problems.parameter import Parameter

SAME_DT = 1e-6  # relative: sample times of logs that are read off stamps


class LogProblem(AssumedProblem):
    """Blocks of recorded runs as the data of a study; the seed of a block is its number.

    The problem decides which blocks are for training and which are held out, whatever the seed of the study: see
    `tuning.problems.log_parts`. A block has a lead-in that filters run through and that is not scored. Blocks of
    other lengths are padded with steps in which nothing is measured; where true states are known all blocks are
    cut to the length of the shortest.

    Without true states there is no scale, and the negative log-likelihood of the innovations is minimised. The
    rule of thumb has the R of the model.

    Args:
        logs: recorded runs with the same sample time, with the model's inputs and measurements.
        assumed: the model that filters assume, or a function of `parameters` that makes it.
        lead: steps of a lead-in.
        blocks: number of blocks of each run; if None there are about 24 in all.
        held_out: names of the held-out runs; if None every third run, or every third block of fewer than three
            runs.
        truth: whether the logs' true states are used, if they have all of them.
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
        lead: int = LEAD,
        blocks: int | None = None,
        held_out: Collection[str] | None = None,
        truth: bool = True,
        content: Mapping | None = None,
        scale: Sequence[float] | None = None,
        parameters: Sequence[Parameter] | None = None,
        untuned: Mapping | None = None,
        name: str | None = None,
        about: str = "",
    ):
        """Cut the logs into blocks; see the class for the arguments."""
        self.logs = _checked_logs(logs)
        self.parts: Parts = parts_of(self.logs, lead, blocks, held_out)
        self._content = content
        super().__init__(
            assumed,
            steps=max(block.rows for block in self.parts.blocks) - 1,
            first_scored_step=lead,
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
        found = [log.true_states(model) if truth else None for log in self.logs]
        known = [states for states in found if states is not None]
        self._states = known if len(known) == len(found) else None
        if self._states is None and self._scale is not None:
            raise ValueError(f"a scale must come with logs of all true states, but {self.name} has not got them")
        if self._states is not None:
            self.parts = parts_of(self.logs, lead, blocks, held_out, sizes=True)
            self.steps = min(block.rows for block in self.parts.blocks) - 1

    @property
    def digest(self) -> str:
        """A hash of the logs' samples, their blocks and everything else that determines the data and the score."""
        logs = tuple(log.digest for log in self.logs)
        return digest_of(logs, self.parts.blocks, len(self.parts.training), self._states is None, self.assumptions)

    def training_seeds(self, seed: int, count: int) -> range:
        """Numbers of all training blocks, whatever the count."""
        return self.parts.training

    def size_seeds(self, seed: int, count: int) -> range:
        """Numbers of the blocks on which the ensemble size is chosen; the training blocks where there are none."""
        return self.parts.sizes or self.parts.training

    def held_out_seeds(self, seed: int, count: int) -> range:
        """Numbers of all held-out blocks, whatever the count."""
        return self.parts.held_out

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
        model, count, rows = self.model(), len(seeds), self.steps + 1
        data = Data(
            seeds,
            np.zeros((count, rows - 1, model.inputs)),
            np.full((count, rows, model.m), np.nan),
            filter_keys(seeds),
            self.first_scored_step,
        )
        states = None if self._states is None else np.empty((count, rows, model.n))
        for place, seed in enumerate(seeds):
            block = self.parts.blocks[seed]
            log, some = self.logs[block.run], slice(block.first, block.first + min(block.rows, rows))
            inputs, measured = log.inputs[some][: rows - 1], log.measurements[some]
            data.inputs[place, : len(inputs)] = inputs
            data.inputs[place, len(inputs) :] = inputs[-1:]
            data.measurements[place, : len(measured)] = measured
            if states is not None and self._states is not None:
                states[place] = self._states[block.run][some]
        if states is None:
            return data
        outputs = {symbol: model.output(symbol, states) for symbol in model.outputs}
        return data._replace(states=states, outputs=outputs)

    def make_env(self, *, run: int = 0, **arguments: Any) -> ReplayEnv:
        """A recorded run as an env that replays it, whatever the action, and offers filters the assumed model.

        Args:
            run: place of the run among the logs.
            **arguments: none.
        """
        if arguments:
            raise ValueError(f"an env of recorded runs must come with run alone, but got {', '.join(arguments)}")
        return ReplayEnv(self.logs[at_least("run", run, 0, len(self.logs) - 1)], self.model)

    def found_scale(self) -> np.ndarray:
        """The standard deviation of each true state over the scored steps of the training blocks."""
        data = self.data(self.parts.training)
        scale = rows_of(data.known_states[:, data.scored], self.model()).std(axis=0)
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


def _checked_logs(given) -> tuple[Log, ...]:
    logs = (given,) if isinstance(given, Log) else tuple(given) if isinstance(given, Sequence) else ()
    if not logs or not all(isinstance(log, Log) for log in logs):
        raise ValueError(f"logs must be some plants.logs.log.Log, but got {shown(given)}")
    for log in logs:
        if abs(log.dt - logs[0].dt) > SAME_DT * logs[0].dt:
            raise ValueError(
                f"logs of one problem must have the same sample time, but {logs[0].name} has {logs[0].dt:g} s and "
                f"{log.name} {log.dt:g} s: put them on one grid with dt"
            )
    names = [log.name for log in logs]
    if len(set(names)) < len(names):
        raise ValueError(f"logs of one problem must have different names, but got {', '.join(names)}")
    return logs


def _name(logs: Sequence[Log]) -> str:
    """What logs are called together: the first one's name, and how many there are more."""
    more = f" and {len(logs) - 1} more" if len(logs) > 1 else ""
    return f"{logs[0].name}{more}"
