"""Filters and smoothers over recorded runs, and their consistency as the innovations show it."""
