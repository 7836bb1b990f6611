"""`python -m thruster_cli`."""

import os
import sys

# `-m` puts the working folder first, where a `struct.py` beside the data would take the place of Python's. What a
# user names is found there all the same (`thruster_env.numerics.modules`). It stays if this package itself lies
# there.
if sys.path[:1] == [os.getcwd()] != [os.path.dirname(os.path.dirname(os.path.abspath(__file__)))]:
    sys.path.pop(0)

from thruster_cli.main import run  # noqa: E402  # by the path as it is now

run()
