"""Makes dapper_windows.json: runs of DAPPER 1.7.1's iEnKS, made as `dapper_analyses.py` says."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from dapper.da_methods.variational import iEnKS
from dapper.tools.matrices import CovMat
from dapper.tools.randvars import GaussRV

R, STEPS, ITERATIONS = [[0.5, 0.2], [0.2, 0.3]], 6, 3


def move(members, *time):
    """f of members (N, 3): a spring that hardens, and what it drives."""
    x, y, w = members.T
    return np.stack([x + 0.3 * y, y - 0.3 * x * (1.0 + 0.2 * x * x), 0.9 * w + 0.2 * x * y], axis=1)


def observe(members):
    """h of members (N, 3): two channels, curved."""
    x, y, w = members.T
    return np.stack([x + 0.2 * y * y, x * y - 0.5 * w], axis=1)


class Dynamics:
    noise = SimpleNamespace(C=0)
    __call__ = staticmethod(move)


class Observation:
    noise = GaussRV(mu=0, C=CovMat(np.array(R)))
    __call__ = staticmethod(observe)


class Starts:
    """Keeps the ensembles at the windows' starts, after each analysis."""

    def __init__(self):
        self.trHK, self.iters, self.infl, self.found = {}, {}, {}, []

    def assess(self, k, ko=None, faus=None, *, E):
        if faus == "s":
            self.found.append(E.T.tolist())


def cases():
    generator = np.random.default_rng(20260102)
    members = np.array([1.0, -0.5, 2.0]) + generator.normal(size=(10, 3)) @ np.diag([0.8, 0.5, 1.5])
    z, truth = [], np.array([[1.4, -0.2, 1.2]])
    for _ in range(STEPS):
        truth = move(truth)
        z.append(observe(truth)[0] + generator.multivariate_normal([0.0, 0.0], R))
    times = SimpleNamespace(Ko=STEPS - 1, kko=np.arange(1, STEPS + 1), cycle=lambda ko: [(ko + 1, ko + 1.0, 1.0)])
    for lag in (1, 3):
        model = SimpleNamespace(
            X0=SimpleNamespace(sample=lambda size: members.copy()),
            Dyn=Dynamics(),
            Obs=lambda ko: Observation(),
            tseq=times,
        )
        method = iEnKS(upd_a="Sqrt", N=len(members), Lag=lag, nIter=ITERATIONS)
        method.stats = Starts()
        iEnKS.assimilate.__wrapped__(method, model, None, [*z, *[None] * lag])
        starts = method.stats.found[: STEPS - lag]
        yield {
            "lag": lag,
            "r": R,
            "z": np.array(z).tolist(),
            "iterations": ITERATIONS,
            "prior": members.T.tolist(),
            "starts": starts,
        }


if __name__ == "__main__":
    lines = ",\n".join(map(json.dumps, cases()))
    Path(__file__).with_suffix(".json").write_text(f"[\n{lines}\n]\n")
