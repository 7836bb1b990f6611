"""Scenarios, evaluation and Optuna studies of a filter's free numbers, proved on data the study never saw."""
