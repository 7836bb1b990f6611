"""`python -m thruster_cli`."""

from thruster_cli.main import run

run()
