"""Optuna studies: what is searched, how trials are scored, and where a study is kept."""
