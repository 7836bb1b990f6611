"""Scenarios, Optuna studies of a filter's free parameters, and evaluation on held-out data."""
