"""Filters whose belief is an ensemble of states, each member as likely as any other."""
