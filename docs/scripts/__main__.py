"""The command line of the scripts."""

import sys

from docs.scripts import main

sys.exit(main())
