"""Makes dapper_analyses.json: analyses by DAPPER 1.7.1, which is not among the packages that tests install.

In an environment of its own: `pip install dapper==1.7.1`, then `python dapper_analyses.py`. DAPPER: Raanes and
others, https://github.com/nansencenter/DAPPER.
"""

import functools
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from dapper.da_methods import ensemble
from dapper.da_methods.ensemble import EnKF_analysis, EnKF_N
from dapper.da_methods.variational import iEnKS_update
from dapper.tools.matrices import CovMat
from dapper.tools.randvars import GaussRV


def observe(members):
    """h of members (N, 3): two channels, curved."""
    x, y, w = members.T
    return np.stack([x + 0.2 * y * y, x * y - 0.5 * w], axis=1)


class Ignored:
    """Takes whatever statistics DAPPER reports, and keeps none."""

    def __init__(self):
        self.trHK, self.iters, self.infl = {}, {}, {}

    def assess(self, *arguments, **named):
        pass


def cases():
    generator = np.random.default_rng(20260101)
    for name, cov in (
        ("correlated", [[0.5, 0.2], [0.2, 0.3]]),
        ("uncorrelated", [[0.5, 0.0], [0.0, 0.3]]),
    ):
        members = np.array([1.0, -0.5, 2.0]) + generator.normal(size=(10, 3)) @ np.diag([0.8, 0.5, 1.5])
        z, noise = np.array([1.9, -0.4]), GaussRV(mu=0, C=CovMat(np.array(cov)))
        expected = observe(members)
        found = {
            kind: EnKF_analysis(members.copy(), expected, noise, z, flavour, Ignored(), 0)
            for kind, flavour in (("etkf", "Sqrt eig"), ("ensrf", "Serial mono"), ("denkf", "DEnKF"))
        }
        model = SimpleNamespace(Obs=lambda ko, noise=noise: _Observation(noise))
        for iterations in (1, 2, 5):
            at, whiten, threshold = (0, 0, 0.0), noise.C.sym_sqrt_inv, (iterations, 0.0)
            found[f"ienkf {iterations}"] = iEnKS_update(
                "Sqrt", members.copy(), [], model, Ignored(), 1.0, z, at, whiten, None, False, threshold
            )
        for certainty in (1, 2):
            found[f"enkf-n {certainty}"] = finite_size(members, z, noise, certainty)
        analyses = {kind: posterior.T.tolist() for kind, posterior in found.items()}
        yield {"name": name, "r": cov, "z": z.tolist(), "prior": members.T.tolist(), "posterior": analyses}


class _Observation:
    def __init__(self, noise):
        self.noise = noise

    def __call__(self, members):
        return observe(members)


def finite_size(members, z, noise, certainty):
    """The analysis of the EnKF-N in its dual form, whose Newton's method ends where rounding does."""
    ensemble.Newton_m = functools.partial(ensemble.Newton_m, xtol=1e-15, ytol=1e-15)
    model = SimpleNamespace(
        X0=SimpleNamespace(sample=lambda size: members.copy()),
        Dyn=_Still(),
        tseq=SimpleNamespace(ticker=[(1, 0, 1.0, 1.0)]),
        Obs=lambda ko: _Observation(noise),
    )
    method = EnKF_N(N=len(members), dual=True, xN=certainty)
    method.stats = _Last()
    EnKF_N.assimilate.__wrapped__(method, model, None, [z])
    return method.stats.members


class _Still:
    noise = SimpleNamespace(C=0)

    def __call__(self, members, *time):
        return members


class _Last(Ignored):
    """Keeps the last ensemble."""

    def assess(self, *arguments, E, **named):
        self.members = E.copy()


if __name__ == "__main__":
    lines = ",\n".join(map(json.dumps, cases()))
    Path(__file__).with_suffix(".json").write_text(f"[\n{lines}\n]\n")
