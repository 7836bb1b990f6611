"""The console command `thruster`; one file a sub-command, each on top of a Python function."""
