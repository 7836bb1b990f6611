"""`python -m tuning.cli`."""

import os
import sys

# `-m` puts the working folder first, where a `struct.py` beside the data would take the place of Python's. What a
# user names is found there all the same (`thruster_env.core.modules`). It stays if this package itself lies
# there.
HOME = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
if sys.path[:1] == [os.getcwd()] != [HOME]:
    sys.path.pop(0)

from tuning.cli.main import run  # noqa: E402  # by the path as it is now

run()
