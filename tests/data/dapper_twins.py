"""Makes dapper_twins.json: twin experiments by DAPPER 1.7.1, which is not among the packages that tests install.

In an environment of its own: `pip install dapper==1.7.1`, then `python dapper_twins.py` (a minute). DAPPER:
Raanes and others, https://github.com/nansencenter/DAPPER.

The system is Lorenz's of 1963, seen every 0.1 time units. DAPPER draws truth and measurements once; its filters
run on them many times, each time with random numbers of their own. Each row of a filter's results is one run: the
root mean square error, and the root mean variance of the members, over all scored analyses.
"""

import json
from pathlib import Path

import dapper.da_methods.ensemble as methods
import dapper.mods as modelling
import numpy as np
from dapper.mods.Lorenz63 import step, x0
from dapper.tools import progressbar
from dapper.tools.matrices import CovMat
from dapper.tools.randvars import GaussRV
from dapper.tools.seeding import set_seed

EVERY, PARTS, CYCLES, SCORED, RUNS, MEMBERS = 0.1, 2, 120, 20, 24, 10
Q, R, PRIOR = [0.5, 0.5, 0.5], [2.0, 2.0, 2.0], [2.0, 2.0, 2.0]


def cycle(x, t, dt):
    """Lorenz's system over one cycle."""
    for _ in range(PARTS):
        x = step(x, t, EVERY / PARTS)
    return x


def gaussian(variances):
    return GaussRV(mu=0, C=CovMat(np.array(variances)))


def system():
    # DAPPER multiplies the noise of the motion by the time step: noise per unit of time.
    motion = {"M": 3, "model": cycle, "noise": gaussian(np.array(Q) / EVERY)}
    seen = {**modelling.partial_Id_Obs(3, np.arange(3)), "noise": gaussian(R)}
    prior = GaussRV(mu=x0, C=CovMat(np.array(PRIOR)))
    return modelling.HiddenMarkovModel(motion, seen, modelling.Chronology(EVERY, dko=1, Ko=CYCLES - 1), prior)


def results(model, truth, measurements, flavour):
    """RMSE and spread of RUNS runs."""
    rows = []
    for seed in range(1, RUNS + 1):
        set_seed(seed)
        method = methods.EnKF(flavour, N=MEMBERS)
        method.assimilate(model, truth, measurements)
        errors = method.stats.mu.a[SCORED:] - truth[1 + SCORED :]
        spread = method.stats.spread.a[SCORED:]
        rows.append([round(float(np.sqrt(np.mean(part**2))), 5) for part in (errors, spread)])
    return rows


if __name__ == "__main__":
    progressbar.disable_progbar = True
    model = system()
    set_seed(20260303)
    truth, measurements = model.simulate()
    truth, measurements = np.round(truth, 5), np.round(np.stack(measurements), 5)
    content = {
        "members": MEMBERS,
        "first scored": SCORED,
        "q": Q,
        "r": R,
        "prior": [list(map(float, x0)), PRIOR],
        "truth": truth[1:].tolist(),
        "z": measurements.tolist(),
        "etkf": results(model, truth, measurements, "Sqrt"),
        "denkf": results(model, truth, measurements, "DEnKF"),
        "enkf, perturbations centred": results(model, truth, measurements, "PertObs"),
    }
    methods.mean0 = lambda sample: sample  # Burgers' perturbations as drawn, as ours are
    content["enkf"] = results(model, truth, measurements, "PertObs")
    Path(__file__).with_suffix(".json").write_text(json.dumps(content, separators=(",", ":")) + "\n")
    for kind in ("etkf", "denkf", "enkf, perturbations centred", "enkf"):
        rows = np.array(content[kind])
        print(kind, rows.mean(axis=0), rows.std(axis=0, ddof=1) / np.sqrt(RUNS))
