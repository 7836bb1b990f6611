"""Small models and filters that tests share, and trajectories drawn from the models."""

import math
from contextlib import nullcontext

import numpy as np

from filters import StateSpaceModel, affine_model, make_filter, thruster_model
from filters.registry import filter_type
from filters.tuned_file import sealed
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate

KEY = (123456789, 4294967295)  # of a filter's random numbers
# One of each kind of page and kernel: what one of the others has in common with it is compiled alike.
OF_EACH_KIND = ("kf-steady", "ekf-robust", "ukf", "vb", "enkf", "ensrf", "pf", "gsf", "fuzzy", "inversion")
DT = 0.05  # of the pendulum


def gaussians(q, r, mean, cov):
    """The arguments of a model that give Q, R, and mean and covariance of the initial state."""
    return {"process_noise_cov": q, "measurement_noise_cov": r, "prior_mean": mean, "prior_cov": cov}


def state_space(f, h, /, q, r, mean, cov, **more):
    """A model by f, h, Q, R, and mean and covariance of the initial state, which further arguments may replace."""
    inputs = {} if "input_quantities" in more else {"inputs": 1}
    return StateSpaceModel(**{"transition": f, "observe": h, **gaussians(q, r, mean, cov), **inputs, **more})


def affine(a, b, c, /, q, r, mean, cov, **more):
    """An affine model by A, B, C, Q, R, and mean and covariance of the initial state, as `state_space`."""
    return affine_model(**{"a": a, "b": b, "c": c, **gaussians(q, r, mean, cov), **more})


def scalar_model(**changes):
    """Affine, n = m = p = 1, without offsets."""
    return affine([[0.9]], [[1.0]], [[2.0]], q=[0.1], r=[0.2], mean=[3.0], cov=[0.5], **changes)


def plane_model(**changes):
    """Affine, n = m = 2, p = 1, with offsets and correlated noise."""
    return affine(
        [[0.9, 0.3], [-0.2, 0.8]],
        [[1.0], [0.5]],
        [[1.0, 0.4], [-0.3, 1.5]],
        q=[[0.3, 0.12], [0.12, 0.2]],
        r=[[0.5, -0.25], [-0.25, 0.4]],
        mean=[1.0, -1.0],
        cov=[[1.0, 0.4], [0.4, 0.5]],
        **{"state_offset": [0.3, -0.2], "measurement_offset": [0.7, -0.1], **changes},
    )


def line_model(**changes):
    """The model of the plane with its first channel only: n = 2, p = m = 1."""
    first = {"c": [[1.0, 0.4]], "measurement_offset": [0.7], "measurement_noise_cov": [0.5]}
    return plane_model(**{**first, **changes})


def wide_model(**changes):
    """Affine, n = 3, p = 2, m = 2, stable, with offsets and correlated noise."""
    return affine(
        [[0.9, 0.2, 0.0], [-0.1, 0.8, 0.1], [0.0, 0.3, 0.7]],
        [[1.0, 0.0], [0.5, -0.4], [0.0, 0.8]],
        [[1.0, 0.0, 0.5], [0.0, 2.0, -1.0]],
        q=[[0.3, 0.1, 0.0], [0.1, 0.2, -0.05], [0.0, -0.05, 0.4]],
        r=[[0.5, 0.2], [0.2, 0.3]],
        mean=[1.0, -1.0, 0.5],
        cov=[[1.0, 0.2, 0.0], [0.2, 0.5, 0.1], [0.0, 0.1, 0.8]],
        **{"state_offset": [0.3, -0.2, 0.1], "measurement_offset": [0.7, -1.5], **changes},
    )


def lonely_model():
    """The scalar model without input, and so without a place to give one."""
    return scalar_model(b=np.zeros((1, 0)))


def random_affine(n=3, m=2, p=2, seed=0):
    """A stable affine model with offsets and full covariances."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()
    b, c = rng.normal(size=(n, p)), rng.normal(size=(m, n))
    offset, shift = rng.normal(size=n), rng.normal(size=m)
    roots = [rng.normal(size=(size, size)) for size in (n, m, n)]
    q, r, p_0 = (root @ root.T + 0.1 * np.eye(len(root)) for root in roots)
    return affine_model(
        a=a,
        b=b,
        c=c,
        state_offset=offset,
        measurement_offset=shift,
        process_noise_cov=q,
        measurement_noise_cov=r,
        prior_mean=rng.normal(size=n),
        prior_cov=p_0,
    )


def rescaled(model, states, channels):
    """An affine model in other units: its states times `states` (n,), its measurements times `channels` (m,)."""
    d, e = np.diag(states), np.diag(channels)
    a, b, offset, c, shift = model.matrices()
    return affine_model(
        a=d @ a @ np.linalg.inv(d),
        b=d @ b,
        c=e @ c @ np.linalg.inv(d),
        state_offset=d @ offset,
        measurement_offset=e @ shift,
        process_noise_cov=d @ model.process_noise_cov @ d,
        measurement_noise_cov=e @ model.measurement_noise_cov @ e,
        prior_mean=d @ model.prior_mean,
        prior_cov=d @ model.prior_cov @ d,
    )


def swing(x, u, c):
    """A damped pendulum, semi-implicit Euler; c = (g/l, damping)."""
    rate = x[1] + DT * (-c[0] * math.sin(x[0]) - c[1] * x[1] * abs(x[1]) + u[0])
    return (x[0] + DT * rate, rate)


def look(x, c):
    """Its horizontal place, and angle times rate."""
    return (math.sin(x[0]), x[0] * x[1])


def pendulum(**changes):
    """n = m = 2, p = 1, nonlinear in both functions, without Jacobians."""
    noise = {"q": [[2e-4, 1e-4], [1e-4, 1e-3]], "r": [[0.01, 0.003], [0.003, 0.04]]}
    prior = {"mean": [0.5, 0.2], "cov": [[0.2, 0.05], [0.05, 0.1]]}
    return state_space(swing, look, **noise, **prior, **{"constants": (9.81, 0.3), **changes})


MODELS = {"thruster": thruster_model, "wide affine": wide_model, "no input": lonely_model}  # for every filter


def simulated(model, steps=100, *, count=1, seed=1, level=3.0, missing=0.0, compiled=False):
    """Normal inputs (count, steps, p) of standard deviation `level`, and the measurements (count, steps + 1, m).

    Of the measurements a part may be missing, channel by channel.
    Compiling a model takes seconds: it pays for many thousand steps only.
    """
    inputs = np.random.default_rng(seed).normal(size=(count, steps, model.inputs)) * level
    with nullcontext() if compiled else interpreted():
        drawn = simulate.simulate(model, episode_keys(range(seed, seed + count)), inputs)
    gone = np.random.default_rng((seed, 1)).random(drawn.measurements.shape) < missing
    return inputs, np.where(gone, np.nan, drawn.measurements)


def varying_noise(model, steps):
    """Q of every step and R of every measurement, the model's times changing factors, as arguments of `run`."""
    factors = np.resize([2.0, 0.5, 1.0, 3.0, 0.3], steps + 1)[:, None, None]
    return {
        "process_noise_covs": factors[:steps] * model.process_noise_cov,
        "measurement_noise_covs": factors[::-1] * model.measurement_noise_cov,
    }


def held_voltages(count, levels, hold=25, seed=20, limit=12.0):
    """Inputs (count, levels * hold, 1) for thrusters: uniform within +-limit, each held for `hold` steps."""
    drawn = np.random.default_rng(seed).uniform(-limit, limit, size=(count, levels, 1))
    return np.repeat(drawn, hold, axis=1)


def small(name, model, size=10):
    """A filter by name; ensembles small, and of a size that fills no vector register."""
    numbers = {"ensemble_size": size} if filter_type(name).has_ensemble else {}
    return make_filter(name, model, **numbers)


# What a tuned file holds at least.
TUNED = sealed(
    {
        "format": "thruster-env tuned filter",
        "version": 2,
        "filter": {
            "name": "enkf",
            "numbers": {"ensemble_size": 20},
            "model": {"process_noise_cov": [1, 4e-4], "measurement_noise_cov": 0.25},
        },
    }
)
