"""Results of long computations that a study and a tuned file store, so that a report need not repeat them.

They are stored with a digest of their inputs (the choice, the problems and the versions of all packages), and
    used only if that is the same. The digest does not prove who wrote them: `tuning.evaluation.verify` recomputes
    held-out metrics.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence

import numpy as np

from tuning.evaluation.baselines import Scaled, baseline_size, rule_label, rule_of_thumb, scaled_rule
from tuning.evaluation.evaluate import Evaluation
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.sizes import SizeRow
from tuning.evaluation.summary import as_interval, numbers, summarised, summary
from tuning.evaluation.versions import versions
from tuning.problems.problem import Problem
from tuning.search.filter_parameters import size_ladder
from tuning.search.plan import SIZE_SEEDS, TRAINING_SEEDS, Plan
from tuning.search.space import Choice

ROLES = ("untuned", "tuned", "true", "scaled", "given", "noise")  # evaluations of a `Comparison`


def sizes_as_data(rows: Sequence[SizeRow], choice: Choice, plan: Plan) -> dict:
    """The table of ensemble sizes of a choice as plain data, with a digest of its inputs."""
    found = [
        {
            "N": row.size,
            "seeds": row.seeds,
            "ratio": numbers(row.ratio),
            "nis_violation": row.outside,
            "metrics": summary(row.evaluation),
        }
        for row in rows
    ]
    return {"digest": _digest_of_sizes(choice, plan), "rows": found}


def stored_sizes(data, choice: Choice, plan: Plan) -> list[SizeRow] | None:
    """The stored table of ensemble sizes if it belongs to this choice, otherwise None.

    Args:
        data: the result of `sizes_as_data`, or anything else.
        choice: its size must be in the table.
        plan: the plan of the study.
    """
    if not isinstance(data, Mapping) or data.get("digest") != _digest_of_sizes(choice, plan):
        return None
    try:
        rows = [
            SizeRow(
                int(row["N"]),
                summarised(row["metrics"], plan.scenarios[0]),
                as_interval(row["ratio"]),
                float(row["nis_violation"]),
                int(row["seeds"]),
            )
            for row in data["rows"]
        ]
    except (KeyError, TypeError, ValueError):
        return None
    return rows if choice.numbers["ensemble_size"] in [row.size for row in rows] else None


def _digest_of_sizes(choice: Choice, plan: Plan) -> str:
    of_filter = {key: value for key, value in choice.numbers.items() if key != "ensemble_size"}
    own = {one.name: choice.model.get(one.name) for one in plan.scenarios[0].parameters or ()}
    model = plan.scenarios[0].model(**choice.model)  # a file may contain more of it than a trial
    noise = [model.process_noise_cov.tolist(), model.measurement_noise_cov.tolist(), model.prior_cov.tolist()]
    of_problems = [one.digest for one in plan.scenarios], plan.consistent, plan.budget, plan.seed
    seeds = SIZE_SEEDS, TRAINING_SEEDS, size_ladder(choice.name)
    text = json.dumps([choice.name, own, noise, of_filter, of_problems, seeds, versions()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def comparison_as_data(comparison: Comparison) -> dict:
    """The data of a comparison that a report needs besides the metrics in a tuned file."""
    found = {role: getattr(comparison, role) for role in ROLES}
    return {
        "expected_nis": _plain(comparison.tuned.expected_nis),
        "median_nees": {role: one and _plain(one.median_nees) for role, one in found.items()},
        "score_ratios": {name: numbers(ratio) for name, ratio in comparison.ratios.items()},
        "likelihood_gains": {name: numbers(gain) for name, gain in comparison.likelihood_gains.items()},
        "over_regression": numbers(comparison.over_regression),
        "no_scaled_default": "" if comparison.default is None else comparison.default.reason,
    }


def stored_comparison(content: Mapping, choice: Choice, problem: Problem) -> Comparison | None:
    """The held-out comparison on a problem that a tuned file stores; None if it has to be recomputed.

    It is recomputed if the file lacks it, or was made with other versions of packages.

    Args:
        content: content of the tuned file.
        choice: the file's choice.
        problem: one of the file's problems, with the file's digest.
    """
    if content.get("made_with") != versions():
        return None
    try:
        held_out, more = content["held_out"][problem.name], content["comparisons"][problem.name]
        found = {role: _summarised(role, held_out, more, problem) for role in ROLES}
        untuned, tuned = found["untuned"], found["tuned"]
        if untuned is None or tuned is None:
            return None
        scaling, reason = held_out["scaled_default"], str(more["no_scaled_default"])
        default = Scaled(None, None, None, reason)
        if scaling["factor"] is not None:
            factor, nis = float(scaling["factor"]), float(scaling["mean_nis"])
            scaled = scaled_rule(rule_of_thumb(choice.name, problem), problem, factor)
            size = baseline_size(choice)
            default = Scaled(scaled if size is None else scaled.with_size(size), factor, nis)
        first, beyond = map(int, held_out["seeds"])
        return Comparison(
            untuned,
            tuned,
            found["true"],
            scaled=found["scaled"],
            bound=np.array([math.nan if part is None else float(part) for part in held_out["bound"]]),
            seeds=range(first, beyond),
            default=default,
            stored_ratios={str(name): as_interval(ratio) for name, ratio in more["score_ratios"].items()},
            stored_gains={str(name): as_interval(gain) for name, gain in more["likelihood_gains"].items()},
            rule=rule_label(problem),
            given=found["given"],
            noise=found["noise"],
            lacks_ranges=problem.lacks_ranges,
            over_regression=as_interval(more.get("over_regression")),
        )
    except (AttributeError, KeyError, TypeError, ValueError):
        return None


def _summarised(role: str, held_out: Mapping, more: Mapping, problem: Problem) -> Evaluation | None:
    if held_out.get(role) is None:  # also of a file that is older than the role
        return None
    return summarised(held_out[role], problem, more["expected_nis"], more["median_nees"][role])


def _plain(value: float) -> float | None:
    return None if math.isnan(value) else value
