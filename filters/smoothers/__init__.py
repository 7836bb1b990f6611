"""Estimates that use later measurements, too."""
