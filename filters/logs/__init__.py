"""Filters and smoothers over recorded runs, and what the innovations say of them."""
