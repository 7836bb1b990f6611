"""Makes dapper_smoother.json: DAPPER 1.7.1's ensemble Kalman smoother with a lag; see dapper_analyses.py.

A plane's affine model without process noise, five members, those of our filter's prior; measured from step 1 on.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from dapper.da_methods.ensemble import EnKS
from dapper.tools.matrices import CovMat
from dapper.tools.randvars import GaussRV

A, OFFSET = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([0.3, -0.2])
H, SHIFT = np.array([[1.0, 0.4], [-0.3, 1.5]]), np.array([0.7, -0.1])
R = np.array([[0.5, -0.25], [-0.25, 0.4]])
PRIOR = [
    [0.2721113489890308, 0.968068716861618, 0.9722308537697251, -0.010543707376916789, 1.8067725604113805],
    [-0.8143643119825683, -0.9586142551353115, -1.0019123367521843, -1.4291071180135475, 0.28827116791514573],
]
Z, LAG = [[1.2, -0.7], [0.4, -1.9], [1.9, 0.3], [0.2, -1.0], [1.1, -2.2]], 2


class _Motion:
    M, noise = 2, SimpleNamespace(C=0)

    def __call__(self, members, *time):
        return members @ A.T + OFFSET


class _Observation:
    noise = GaussRV(mu=0, C=CovMat(R))

    def __call__(self, members):
        return members @ H.T + SHIFT


class _Smoothed:
    trHK = {}

    def __init__(self):
        self.members = {}

    def assess(self, k, ko, which, E):
        if which in "us":
            self.members[k] = E.copy()


def smoothed():
    steps = len(Z)
    ticker = [(k, k - 1, float(k), 1.0) for k in range(1, steps + 1)]
    method = EnKS(upd_a="Sqrt", N=5, Lag=LAG)
    method.stats = _Smoothed()
    model = SimpleNamespace(
        X0=SimpleNamespace(sample=lambda size: np.transpose(PRIOR)),
        Dyn=_Motion(),
        tseq=SimpleNamespace(K=steps, dko=1, ticker=ticker),
        Obs=lambda ko: _Observation(),
    )
    EnKS.assimilate.__wrapped__(method, model, None, Z)
    members = [method.stats.members[k].T.tolist() for k in range(1, steps + 1)]
    return {"prior": PRIOR, "z": Z, "lag": LAG, "members": members}


if __name__ == "__main__":
    Path(__file__).with_suffix(".json").write_text(json.dumps(smoothed()) + "\n")
