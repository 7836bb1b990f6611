"""Filters and smoothers over recorded runs, and what the innovations show of their consistency."""
