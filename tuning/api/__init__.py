"""The functions of `tuning` and what they return: one call for each thing that the command line does."""
