"""Machine code follows from all values that a function reads, wherever they are."""

import sys
import textwrap
import types

import numpy as np
import pytest

from thruster_env.core.compiled import code_text, function_fingerprint

USERS = """
import params
from params import K
from params import TABLE

def direct(x):
    return K * x

def attribute(x):
    return params.K * x

def nested(x):
    def inner(y):
        return params.deeper.K * y
    return inner(x)

def listed(x):
    return TABLE[0] * x

def made(k):
    def closed(x):
        return k * x
    return closed

def outer(x):
    return direct(x)
"""


def users(monkeypatch, k):
    """A user's file, the numbers of which are in another file of his."""
    params = types.ModuleType("params")
    params.deeper = types.ModuleType("params.deeper")
    params.K, params.deeper.K, params.TABLE, params.other = k, k, np.array([k, 1.0]), object()
    monkeypatch.setitem(sys.modules, "params", params)
    found = types.ModuleType("mine")
    exec(compile(textwrap.dedent(USERS), "mine.py", "exec"), found.__dict__)
    found.closed = found.made(k)
    return found


@pytest.mark.parametrize("name", ["direct", "attribute", "nested", "listed", "closed", "outer"])
def test_another_number_in_another_file_is_another_code(monkeypatch, name):
    one, same, other = (getattr(users(monkeypatch, k), name) for k in (2.0, 2.0, 3.0))
    prints = [function_fingerprint(part) for part in (one, same, other)]
    assert prints[0] == prints[1] != prints[2]


def test_objects_tell_nothing_for_their_addresses_differ(monkeypatch):
    assert "object at" not in code_text(users(monkeypatch, 2.0).attribute)
