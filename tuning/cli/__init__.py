"""The console command `thruster`; one file per sub-command, each on top of a Python function."""
