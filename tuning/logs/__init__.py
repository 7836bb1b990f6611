"""Recorded runs as a user names them: the log, its model, and the problem of several logs."""
