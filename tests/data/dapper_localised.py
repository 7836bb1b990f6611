"""Makes dapper_localised.json: localised analyses by DAPPER 1.7.1; see dapper_analyses.py.

Eight states on a ring and four channels, at every other one.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from dapper.da_methods.ensemble import SL_EAKF, local_analyses
from dapper.tools.localization import nd_Id_localization
from dapper.tools.matrices import CovMat
from dapper.tools.randvars import GaussRV

RADIUS = 1.2
THEIRS = RADIUS * (10.0 / 3.0) ** 0.5 / 1.82  # who round the constant of Gaspari and Cohn's taper


def observe(members):
    """h of members (N, 8): four channels, curved."""
    seen = members[:, ::2]
    return seen + 0.1 * seen * seen


class _Observation:
    localizer = staticmethod(nd_Id_localization((8,), (1,), obs_inds=np.arange(0, 8, 2)))

    def __init__(self, noise):
        self.noise = noise

    def __call__(self, members):
        return observe(members)


class _Still:
    noise = SimpleNamespace(C=0)

    def __call__(self, members, *time):
        return members


class _Last:
    def assess(self, *arguments, E, **named):
        self.members = E.copy()


def analyses():
    generator = np.random.default_rng(20260102)
    members = generator.normal(size=(5, 8)) * np.linspace(0.5, 1.5, 8) + np.sin(np.arange(8))
    z, r = np.array([0.4, 1.2, -0.6, -0.1]), np.array([0.5, 0.3, 0.4, 0.2])
    noise = GaussRV(mu=0, C=CovMat(r, kind="diag"))
    batches, taper = _Observation.localizer(THEIRS, "x2y", "GC")
    letkf, _ = local_analyses(members.copy(), observe(members), noise.C, z, batches, taper)
    serial = SL_EAKF(N=5, loc_rad=THEIRS, ordr="mono")
    serial.stats = _Last()
    model = SimpleNamespace(
        X0=SimpleNamespace(sample=lambda size: members.copy()),
        Dyn=_Still(),
        tseq=SimpleNamespace(ticker=[(1, 0, 1.0, 1.0)]),
        Obs=lambda ko: _Observation(noise),
    )
    SL_EAKF.assimilate.__wrapped__(serial, model, None, [z])
    found = {"letkf": letkf.T.tolist(), "ensrf": serial.stats.members.T.tolist()}
    return {"radius": RADIUS, "r": r.tolist(), "z": z.tolist(), "prior": members.T.tolist(), "posterior": found}


if __name__ == "__main__":
    Path(__file__).with_suffix(".json").write_text(json.dumps(analyses()) + "\n")
