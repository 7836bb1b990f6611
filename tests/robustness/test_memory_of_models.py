"""Models that nobody has any more, with functions of their own, take no memory: caches are bounded."""

import gc
import linecache
import weakref

import numpy as np

from filters import make_filter, run
from tests.models import state_space
from thruster_env.core.streams import episode_keys
from thruster_env.graphs import programs
from thruster_env.model.simulate import simulate

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
    noise, prior = {"q": [0.01, 0.01], "r": [0.1]}, {"mean": [0.0, 0.0], "cov": [1.0, 1.0]}
    model = state_space(names["transition"], names["observe"], **noise, **prior, inputs=0)
    run(make_filter("ekf", model), None, None, np.zeros((1, 3, 1)))
    simulate(model, episode_keys([0]), np.zeros((1, 2, 0)))
    return weakref.ref(model), weakref.ref(model.transition), weakref.ref(model.observe)


def sizes():
    while gc.collect():  # what a cycle had may have had another
        pass
    return {
        "texts": len(programs._TEXTS),
        "lines": len(linecache.cache),
    }


def test_a_hundred_models_that_were_dropped_leave_no_more_than_the_caches_keep(as_python, only_new_garbage):
    alive = [one for number in range(80) for one in used(0.1 + 1e-3 * number)]
    before = sizes()
    alive += [one for number in range(80, 110) for one in used(0.1 + 1e-3 * number)]
    after = sizes()
    models, *functions = ([one() for one in alive[place::3]] for place in range(3))
    assert sum(one is not None for one in models) <= 1
    assert all(sum(one is not None for one in some) <= KEPT for some in functions)
    assert all(after[name] <= count + 8 for name, count in before.items()), (before, after)
