"""Models that nobody has any more, with functions of their own, take no memory: caches are bounded."""

import gc
import linecache
import weakref

import numpy as np

from filters import make_filter, run
from thruster_env.core.streams import episode_keys
from thruster_env.graphs import programs
from thruster_env.model.simulate import simulate
from thruster_env.model.state_space import StateSpaceModel

KEPT = 64  # models whose code the caches keep
TEXT = """
def transition(x, u, c):
    return (0.9 * x[0] + {0!r} * x[1], 0.8 * x[1] + {0!r} * x[0] * x[1])

def observe(x, c):
    return (x[0] * {0!r},)
"""


def used(number):
    """Weak references to a model and its functions, which no other has, after a filter and a simulation."""
    names = {}
    exec(TEXT.format(number), names)
    model = StateSpaceModel(
        transition=names["transition"],
        observe=names["observe"],
        process_noise_cov=[0.01, 0.01],
        measurement_noise_cov=[0.1],
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0, 1.0],
        inputs=0,
    )
    run(make_filter("ekf", model), None, None, np.zeros((1, 3, 1)))
    simulate(model, episode_keys([0]), np.zeros((1, 2, 0)))
    return weakref.ref(model), weakref.ref(model.transition), weakref.ref(model.observe)


def sizes():
    while gc.collect():  # what a cycle held may have held another
        pass
    return {
        "texts": len(programs._TEXTS),
        "lines": len(linecache.cache),
    }


def test_two_hundred_models_that_were_dropped_leave_no_more_than_the_caches_keep(as_python):
    alive = [one for number in range(140) for one in used(0.1 + 1e-3 * number)]
    before = sizes()
    alive += [one for number in range(140, 200) for one in used(0.1 + 1e-3 * number)]
    after = sizes()
    models, *functions = ([one() for one in alive[place::3]] for place in range(3))
    assert sum(one is not None for one in models) <= 1
    assert all(sum(one is not None for one in some) <= KEPT for some in functions)
    assert all(after[name] <= count + 8 for name, count in before.items()), (before, after)
