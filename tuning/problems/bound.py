"""The posterior Cramér-Rao bound of a problem, which is computed once for all commands."""

from __future__ import annotations

import numpy as np

from filters.posterior import gathering_code, posterior_variances, sequences_taken
from thruster_env.core.number_cache import cached_numbers
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.data import Data
from tuning.problems.digest import digest_of


def average_bound(model: StateSpaceModel, data: Data, truths: int = 100) -> np.ndarray:
    """Root of the bound's variances (n,), averaged over the scored steps of all runs.

    A minute's work for a model of many substeps, and the same for each command on a problem: it is kept beside
    the machine code, by everything that it follows from.

    Args:
        model: the model that draws the truth; Q must be positive definite.
        data: its inputs are those of the bound, a sequence a run.
        truths: truths drawn for each sequence.
    """
    inputs = np.ascontiguousarray(data.seen.inputs, dtype=np.float64)
    code, sources = gathering_code(model)
    told = sources, digest_of(model, *model.functions), data.first_scored, truths, inputs.shape
    counted = b"" if data.counted is None else np.ascontiguousarray(data.counted).tobytes()
    follows_from = repr(told).encode() + model.numbers.tobytes() + inputs.tobytes() + counted

    def compute() -> np.ndarray:
        variances = posterior_variances(model, inputs, truths=truths)
        if data.counted is None:
            return np.sqrt(data.pooled(variances))
        taken = sequences_taken(inputs, truths, model)
        if len(taken) == 1:  # of all sequences, where they are the same
            variances, taken = np.repeat(variances, len(inputs), axis=0), np.arange(len(inputs))
        return np.sqrt(data._replace(counted=data.counted[taken]).pooled(variances))

    return cached_numbers("bound", model.n, follows_from, code, compute)
