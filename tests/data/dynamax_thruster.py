"""Makes dynamax_thruster.json: the thruster written a second time, and what dynamax 1.0.3 makes of it.

In an environment of its own: `pip install dynamax==1.0.3 jax==0.10.2`, then `python dynamax_thruster.py` (a
minute). dynamax: Linderman and others, https://github.com/probml/dynamax. Nothing here is imported from this
project: the equations are those in print, with their angles, and JAX differentiates them.

It writes data (voltages, measurements) drawn from the thruster, the means, covariances and log-likelihoods of
dynamax's extended and unscented filters on them, and the posterior Cramer-Rao bound under the same voltages.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from dynamax.nonlinear_gaussian_ssm import (
    ParamsNLGSSM,
    UKFHyperParams,
    extended_kalman_filter,
    unscented_kalman_filter,
)

jax.config.update("jax_enable_x64", True)

# The tunnel thruster of Nurhadi et al. (2022), Table 1, as printed.
C_L, C_D, K1, K2, K_H, K3, K4 = 1.75, 1.2, 70.15, 1133.2, 17.79, 0.954, 0.910
AREA, RADIUS, GEAR, DENSITY, BLADE = 0.00445, 0.0381, 2.0, 998.0, jnp.pi / 6
DT, PARTS, STEPS, TRUTHS = 0.01, 2, 200, 200_000
MEAN, PRIOR = jnp.array([20.0, 0.3]), jnp.diag(jnp.array([1.0, 0.01]))
Q = jnp.diag(jnp.array([1.0, 4e-4]))
R = {"thrust": [[0.25]], "thrust and speed": [[0.25, 0.1], [0.1, 0.5]]}
FIELDS = ["filtered_means", "filtered_covariances", "marginal_loglik"]
POINTS = {"thrust": (1.0, 2.0, 0.0), "thrust and speed": (0.5, 2.0, 1.0)}  # alpha, beta, kappa


def forces(x):
    """Thrust [N] and torque [N m] at (omega_m, U_a)."""
    blade = 0.7 * RADIUS * x[0] / GEAR
    attack = jnp.pi / 2 - BLADE - jnp.arctan2(x[1], blade)
    pressure = 0.5 * DENSITY * (blade**2 + x[1] ** 2) * AREA
    lift, drag = pressure * C_L * jnp.sin(2 * attack), pressure * C_D * (1 - jnp.cos(2 * attack))
    theta = BLADE - attack
    thrust = lift * jnp.cos(theta) - drag * jnp.sin(theta)
    return thrust, 0.7 * RADIUS * (lift * jnp.sin(theta) + drag * jnp.cos(theta))


def rates(x, voltage):
    """Time derivatives of the state in still water."""
    thrust, torque = forces(x)
    return jnp.stack([-K1 * x[0] + K2 * voltage - K_H * torque, (thrust - K4 * x[1] * jnp.abs(x[1])) / K3])


def step(x, u):
    """The state after DT, by the classic Runge-Kutta method."""
    h = DT / PARTS
    for _ in range(PARTS):
        k1 = rates(x, u[0])
        k2 = rates(x + h / 2 * k1, u[0])
        k3 = rates(x + h / 2 * k2, u[0])
        k4 = rates(x + h * k3, u[0])
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


SEEN = {
    "thrust": lambda x, u=None: jnp.stack([forces(x)[0]]),
    "thrust and speed": lambda x, u=None: jnp.stack([forces(x)[0], x[0]]),
}


def drawn(generator, inputs, channels):
    """Measurements (K + 1, m) of one truth, rounded to what the file holds."""
    r_root, h, move = np.linalg.cholesky(np.array(R[channels])), jax.jit(SEEN[channels]), jax.jit(step)
    x = np.array(MEAN) + np.sqrt(np.diag(PRIOR)) * generator.normal(size=2)
    found = []
    for k in range(STEPS + 1):
        if k > 0:
            x = np.array(move(x, inputs[k - 1])) + np.sqrt(np.diag(Q)) * generator.normal(size=2)
        found.append(np.array(h(x)) + r_root @ generator.normal(size=len(r_root)))
    return np.round(found, 6)


def estimates(inputs, measurements, channels):
    """What dynamax's filters say; it takes the input that led to a measurement in the measurement's row."""
    params = ParamsNLGSSM(MEAN, PRIOR, step, Q, SEEN[channels], jnp.array(R[channels]))
    given = jnp.array(measurements), jnp.concatenate([inputs[:1], inputs])
    alpha, beta, kappa = POINTS[channels]
    found = {
        "ekf": extended_kalman_filter(params, given[0], inputs=given[1], output_fields=FIELDS),
        "ukf": unscented_kalman_filter(
            params, given[0], UKFHyperParams(alpha, beta, kappa), inputs=given[1], output_fields=FIELDS
        ),
    }
    for kind, posterior in found.items():
        covs = np.array(posterior.filtered_covariances)
        rows = [
            posterior.filtered_means,
            covs[:, [0, 0, 1], [0, 1, 1]],
            np.array(posterior.marginal_loglik)[:, None],
        ]
        yield kind, [[float(f"{value:.10g}") for value in row] for row in np.hstack(rows).tolist()]


def bound(inputs):
    """Posterior Cramer-Rao bound (K + 1, 2, 2), thrust measured: Tichavsky et al. (1998), eqs. 21 and 34-36."""
    q_inverse, r_inverse = jnp.linalg.inv(Q), 1.0 / R["thrust"][0][0]
    slope_of_motion = jax.vmap(jax.jacfwd(step), (0, None))
    slope_of_thrust = jax.vmap(jax.jacfwd(lambda x: forces(x)[0]))

    @jax.jit
    def seen(x):
        h = slope_of_thrust(x)
        return jnp.einsum("ti,tj->ij", h, h) * r_inverse / TRUTHS

    @jax.jit
    def moved(key, x, u):
        f = slope_of_motion(x, u)
        noise = jax.random.normal(key, x.shape) @ jnp.sqrt(Q)
        d11 = jnp.einsum("tji,jk,tkl->il", f, q_inverse, f) / TRUTHS
        return f.mean(axis=0), d11, jax.vmap(step, (0, None))(x, u) + noise

    keys = jax.random.split(jax.random.key(7), STEPS + 1)
    x = MEAN + jax.random.normal(keys[-1], (TRUTHS, 2)) @ jnp.sqrt(PRIOR)
    information = jnp.linalg.inv(PRIOR) + seen(x)
    found = [jnp.linalg.inv(information)]
    for key, u in zip(keys, inputs, strict=False):
        f, d11, x = moved(key, x, u)
        d12 = -f.T @ q_inverse
        information = q_inverse + seen(x) - d12.T @ jnp.linalg.solve(information + d11, d12)
        found.append(jnp.linalg.inv(information))
    return [[float(f"{value:.7g}") for value in np.array(p)[[0, 0, 1], [0, 1, 1]]] for p in found]


if __name__ == "__main__":
    generator = np.random.default_rng(20260202)
    inputs = np.repeat(np.round(generator.uniform(-12, 12, size=(8, 1)), 3), STEPS // 8, axis=0)
    content = {"voltages": inputs[:, 0].tolist(), "bound": bound(inputs), "cases": []}
    for channels in SEEN:
        measurements = drawn(generator, inputs, channels)
        case = {"channels": channels, "r": R[channels], "points": POINTS[channels], "z": measurements.tolist()}
        content["cases"].append({**case, **dict(estimates(jnp.array(inputs), measurements, channels))})
    Path(__file__).with_suffix(".json").write_text(json.dumps(content, separators=(",", ":")) + "\n")
