"""Other people's estimators in the place of a filter."""
