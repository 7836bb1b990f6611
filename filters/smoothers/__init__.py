"""Smoothers: estimates that also use later measurements."""
