"""Makes gtsam_rotations.json: exponentials, logarithms, their derivatives and steps of a filter by gtsam 4.3.0.

In an environment of its own: `pip install gtsam==4.3.0`, then `python gtsam_rotations.py`. gtsam: Dellaert and
others, https://github.com/borglab/gtsam. Nothing here is imported from this project.

Rotations are written as matrices. Poses with velocity have tangents of rotation, velocity and position. A step of
`ManifoldEKFRot3` turns by a rate, then measures a direction; its covariances are of errors in body axes.
"""

import json
from pathlib import Path

import gtsam
import numpy as np

ANGLES = (0.0, 1e-9, 1e-4, 0.3, 2.0, 3.1, np.pi - 1e-7)
NORTH, Q, R = np.array([0.5, 0.1, -0.86]), 1e-3, 0.02
SWAP = np.r_[0:3, 6:9, 3:6]  # gtsam has position before velocity


def skew(v):
    """The matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotations(rng):
    """The exponential, the logarithm of it, and the derivatives of both, of turns about drawn axes."""
    cases = []
    for angle in ANGLES:
        axis = rng.normal(size=3)
        d = angle * axis / np.linalg.norm(axis)
        turned = gtsam.Rot3.Expmap(d)
        right, inverse = gtsam.Rot3.ExpmapDerivative(d), gtsam.Rot3.LogmapDerivative(d)
        cases.append([d, turned.matrix(), gtsam.Rot3.Logmap(turned), right, inverse])
    return cases


def poses(rng):
    """The exponential of tangents, and the logarithm of a product of two."""
    cases = []
    for angle in ANGLES[:-1]:
        first, second = rng.normal(size=(2, 9))
        first[:3] *= angle / np.linalg.norm(first[:3])
        a, b = (gtsam.NavState.Expmap(d[SWAP]) for d in (first, second))
        product = gtsam.NavState.Logmap(a.compose(b))[SWAP]
        cases.append([first, second, a.attitude().matrix(), a.velocity(), a.position(), product])
    return cases


def steps(rng, count=12):
    """State and covariance before a step, rate times time, the measurement, and state and covariance after it."""
    cases = []
    for _ in range(count):
        start, root = gtsam.Rot3.Expmap(rng.normal(size=3)), 0.3 * rng.normal(size=(3, 3))
        P, d = root @ root.T + 1e-3 * np.eye(3), 0.4 * rng.normal(size=3)
        z = start.compose(gtsam.Rot3.Expmap(d + 0.2 * rng.normal(size=3))).matrix().T @ NORTH
        filter_, turn = gtsam.ManifoldEKFRot3(start, P), gtsam.Rot3.Expmap(d)
        filter_.predict(start.compose(turn), turn.matrix().T, Q * np.eye(3))
        predicted = filter_.state().matrix().T @ NORTH
        filter_.updateWithVector(predicted, skew(predicted), z, R * np.eye(3))
        cases.append([start.matrix(), P, d, z, filter_.state().matrix(), filter_.covariance()])
    return cases


if __name__ == "__main__":
    drawn = np.random.default_rng(0)
    content = {"rotations": rotations(drawn), "poses": poses(drawn), "steps": steps(drawn)}
    text = json.dumps(content, default=lambda array: np.asarray(array).tolist())
    Path(__file__).with_suffix(".json").write_text(text + "\n", encoding="utf-8")
