"""Optuna studies: the search space, the scores of trials, and the storage."""
