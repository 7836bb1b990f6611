"""Recorded runs as a user names them: which log, whose model, and the problem that some logs make."""
