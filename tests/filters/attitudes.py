"""A model of an attitude, its simulated data and a naive filter of it, for the tests of rotations."""

import ctypes
import subprocess

import numpy as np
from scipy.spatial.transform import Rotation as Turned

import filters
from filters.c.project import c_filter, write_filter
from thruster_env.model import rotations
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Rotation

ENSEMBLES = "enkf", "etkf", "letkf", "ensrf", "denkf", "ienkf", "enkf-n"
OTHERS = "pf", "apf", "rbpf", "imm", "mmae", "gsf", "mhe"  # of particles, modes, parts and windows
DT, GYRO, WALK, SENSOR, BIAS = 0.1, 2e-3, 2e-4, 0.05, 0.02
GRAVITY, FIELD = (0.0, 0.0, 1.0), (0.0, 0.6, -0.8)
TAKE_ROTATIONS = {  # each with parameters that make it another one, with others
    "ekf": ({}, "ekf", {}),
    "iekf": ({"iterations": 1}, "ekf", {}),
    "fading": ({"fading": 1.0}, "ekf", {}),
    "schmidt": ({}, "ekf", {}),
    "h-infinity": ({"theta": 1e-12}, "ekf", {}),
    "vb": ({"forgetting_factor": 1.0, "prior_weight": 1e14}, "ekf", {}),
    "ekf-robust": ({"degrees_of_freedom": 1e14}, "ekf", {}),
    "sage-husa": ({"forgetting_factor": 1.0}, "ekf", {}),
    "ckf": ({}, "ukf", {"beta": 0.0}),
    "ukf": ({"beta": 0.0}, "ckf", {}),
}


def advance(x, u, c):
    """A gyroscope turns the attitude; its bias is constant."""
    q, bias = x[:4], x[4:]
    return *rotations.product(q, rotations.exponential(tuple((u[i] - bias[i]) * c[0] for i in range(3)))), *bias


def directions(x, c):
    """Gravity and the magnetic field in the axes of the body."""
    return *rotations.to_body(x[:4], GRAVITY), *rotations.to_body(x[:4], FIELD)


def attitude_model(side="body", degrees=5.0, start=(1.0, 0.0, 0.0, 0.0)):
    """Attitude and bias of a gyroscope."""
    return StateSpaceModel(
        transition=advance,
        observe=directions,
        process_noise_cov=[GYRO**2 * DT] * 3 + [WALK**2 * DT] * 3,
        measurement_noise_cov=[SENSOR**2] * 6,
        prior_mean=[*start, 0.0, 0.0, 0.0],
        prior_cov=[np.deg2rad(degrees) ** 2] * 3 + [BIAS**2] * 3,
        constants=(DT,),
        states=(Rotation("attitude", side=side), "b_x", "b_y", "b_z"),
        input_quantities=("w_x", "w_y", "w_z"),
    )


def simulated(runs, steps, degrees):
    """True attitudes and biases (runs, steps + 1, 7) about an estimate of none, gyroscope and measurements."""
    draw = np.random.default_rng(1).normal
    q, bias = Turned.from_rotvec(np.deg2rad(degrees) * draw(size=(runs, 3))), BIAS * draw(size=(runs, 3))
    truth, gyro, z = [], [], []
    for k in range(steps + 1):
        x, y, zz, w = q.as_quat().T
        truth.append(np.column_stack([w, x, y, zz, bias]))
        channels = np.column_stack([q.inv().apply(GRAVITY), q.inv().apply(FIELD)])
        z.append(channels + SENSOR * draw(size=(runs, 6)))
        rate = np.sin(0.3 * k * DT + np.arange(3)) * 0.5
        gyro.append(rate + bias + GYRO / np.sqrt(DT) * draw(size=(runs, 3)))
        q, bias = (
            q * Turned.from_rotvec(np.tile(rate * DT, (runs, 1))),
            bias + WALK * DT**0.5 * draw(size=(runs, 3)),
        )
    return (np.stack(part, axis=1) for part in (truth, gyro[:-1], z))


def errors_of(truth, means):
    """Errors of the body (..., 6)."""
    stored, estimated = (Turned.from_quat(part[..., [1, 2, 3, 0]].reshape(-1, 4)) for part in (truth, means))
    turned = (estimated.inv() * stored).as_rotvec().reshape(*means.shape[:-1], 3)
    return np.concatenate([turned, truth[..., 4:] - means[..., 4:]], axis=-1)


def nees_of(truth, estimates):
    """Squares of the errors in units of P, (runs, steps)."""
    errors = errors_of(truth, estimates.means)
    return np.einsum("bki,bki->bk", errors, np.linalg.solve(estimates.covs, errors[..., None])[..., 0])


def skew(v):
    return np.cross(np.eye(3), v)


def naive(gyro, z, degrees):
    """The error-state filter of the body with the exact reset, of one run, in matrices: last q, bias and P."""
    q, bias = Turned.identity(), np.zeros(3)
    P, Q = (
        np.diag([np.deg2rad(degrees) ** 2] * 3 + [BIAS**2] * 3),
        np.diag([GYRO**2 * DT] * 3 + [WALK**2 * DT] * 3),
    )
    for k, measured in enumerate(z):
        if k:
            turn = (gyro[k - 1] - bias) * DT
            F = np.eye(6)
            F[:3, :3] = Turned.from_rotvec(turn).as_matrix().T
            F[:3, 3:] = -np.array(rotations.left_jacobian(-turn)) * DT
            q, P = q * Turned.from_rotvec(turn), F @ P @ F.T + Q
        expected = q.inv().apply([GRAVITY, FIELD])
        H = np.zeros((6, 6))
        H[:3, :3], H[3:, :3] = skew(expected[0]), skew(expected[1])
        S = H @ P @ H.T + SENSOR**2 * np.eye(6)
        K = np.linalg.solve(S, H @ P).T
        d = K @ (measured - expected.ravel())
        G = np.eye(6)
        G[:3, :3] = rotations.left_jacobian(-d[:3])
        P = G @ (P - K @ S @ K.T) @ G.T
        q, bias = q * Turned.from_rotvec(d[:3]), bias + d[3:]
    return q, bias, P


def ran(model, inputs, measurements, name="ekf", **numbers):
    """Estimates of a filter by its name."""
    return filters.run(filters.make_filter(name, model, **numbers), inputs=inputs, measurements=measurements)


def c_library(filter_, name, folder, *more):
    """A filter in C, compiled with further files, and memory for its struct; numbers after x, P and S are four."""
    files = write_filter(c_filter(filter_, name), folder)
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-shared", "-fPIC"]
    subprocess.run(["gcc", *flags, *map(str, (files[1], *more)), "-o", folder / "c.so", "-lm"], check=True)
    n, e = filter_.model.n, len(filter_.model.prior_cov)
    m = len(filter_.model.measurement_noise_cov)
    return ctypes.CDLL(str(folder / "c.so")), np.zeros(n + e * e + m + m * m + 4)


def address(array):
    return array.ctypes.data_as(ctypes.c_void_p)
