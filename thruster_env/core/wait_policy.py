"""How worker threads wait for the next call: "active", spinning for half a millisecond, or "passive", asleep.

The words are those of OpenMP's OMP_WAIT_POLICY. The environment variable THRUSTER_WAIT_POLICY sets the policy of
a process and of all that it starts, `waiting` that of a part of a program.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from thruster_env.core.checks import one_of

VARIABLE = "THRUSTER_WAIT_POLICY"
ACTIVE, PASSIVE = "active", "passive"


_policy: str | None = None  # None: the environment has not been asked yet


def wait_policy() -> str:
    """The policy in force: "active", unless the environment, as it first was, or `waiting` says otherwise.

    Raises:
        ValueError: if the environment variable holds another word.
    """
    global _policy
    if _policy is None:
        _policy = one_of(VARIABLE, os.environ.get(VARIABLE, ACTIVE), (ACTIVE, PASSIVE))
    return _policy


@contextmanager
def waiting(policy: str) -> Iterator[None]:
    """Within this context worker threads wait by this policy, also those of processes that are started in it.

    Args:
        policy: "active" where the program's next call comes soon and the cores are its own, "passive" where other
            threads or processes, such as torch's, want them between calls.

    Raises:
        ValueError: if the policy is neither.
    """
    global _policy
    before, inherited = _policy, os.environ.get(VARIABLE)
    _policy = os.environ[VARIABLE] = one_of("policy", policy, (ACTIVE, PASSIVE))
    try:
        yield
    finally:
        _policy = before
        if inherited is None:
            os.environ.pop(VARIABLE, None)
        else:
            os.environ[VARIABLE] = inherited
