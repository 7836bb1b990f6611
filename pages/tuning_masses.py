"""A chain of masses whose springs the filter has wrong: many numbers, for docs/tuning.md."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm

from thruster_env.core.text_tables import markdown_table
from thruster_env.model.affine import affine_model
from tuning.evaluation.baselines import GIVEN, NOISE
from tuning.evaluation.evaluate import score_ratio
from tuning.evaluation.held_out import evaluate_held_out
from tuning.likelihood.gradient import tune_by_gradient
from tuning.problems.model_problem import ModelProblem
from tuning.search.plan import Plan
from tuning.search.study import open_study, quiet_optuna, run_study

MASSES, MEASURED, DT, STEPS, SEED, TRIALS = 5, (0, 2, 4), 0.1, 300, 1, 100
STIFFNESS, DAMPING = 4.0, 0.2  # over the mass
WRONG = 0.5  # relative errors of the springs, at most


def masses(seed: int = SEED) -> ModelProblem:
    """Positions and speeds of masses between springs, of which the filter has the stiffness wrong."""
    random, n = np.random.default_rng(seed), MASSES
    springs = STIFFNESS * (2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    motion = np.block([[np.zeros((n, n)), np.eye(n)], [-springs, -DAMPING * np.eye(n) - 0.02 * springs]])
    q = np.concatenate([1e-5 * np.exp(random.normal(0, 1, n)), 1e-2 * np.exp(random.normal(0, 1.5, n))])
    r = 1e-2 * np.exp(random.normal(0, 1, len(MEASURED)))
    wrong = motion.copy()
    wrong[n:, :n] *= 1.0 + WRONG * random.uniform(-1, 1, (n, n))

    def model(of: np.ndarray, q: np.ndarray, r: np.ndarray):
        return affine_model(
            a=expm(of * DT),
            b=np.zeros((2 * n, 1)),
            c=np.eye(2 * n)[list(MEASURED)],
            process_noise_cov=q,
            measurement_noise_cov=r,
            prior_mean=np.zeros(2 * n),
            prior_cov=0.1 * np.eye(2 * n),
        )

    assumed = model(wrong, np.full(2 * n, 1e-3), np.full(len(MEASURED), 0.1))
    return ModelProblem(model(motion, q, r), assumed, np.zeros((STEPS, 1)), name="masses")


def many() -> str:
    """The score of searches among many numbers, over that of the given Q and R."""
    quiet_optuna()
    problem = masses()
    plan = Plan("kf", (problem,))
    data = plan.training_data()
    study = run_study(open_study("page", plan, None), plan, TRIALS).or_interrupted()
    rows, choices = [], {f"study of diagonal Q and R, {TRIALS} trials": study.choice}
    for name, options in (("diagonal", {}), ("full", {"full_q": True, "full_r": True})):
        ended = tune_by_gradient("kf", problem, data, [1.0], "score", options)
        choices[f"gradient of the score, {name} Q and R, {len(ended.free)} numbers"] = ended.choice
    for name, choice in choices.items():
        comparison = evaluate_held_out(choice, problem, plan.seed)
        if not rows:
            ratio = score_ratio(comparison.evaluations[NOISE], comparison.evaluations[GIVEN])
            rows.append(["noise estimation", f"{ratio.value:.2f}"])
        rows.append([name, f"{comparison.ratios[GIVEN].value:.2f}"])
    return markdown_table(["", "score over the given one"], rows)


TABLES: dict[str, Callable[[], str]] = {"many": many}
