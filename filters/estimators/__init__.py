"""Estimators of other packages in place of a filter."""
