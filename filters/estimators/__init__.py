"""Estimators of other packages in the place of a filter."""
