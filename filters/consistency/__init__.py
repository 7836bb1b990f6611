"""Is a filter consistent? Its errors and innovations are compared with the covariances that it reports.

The checks are NEES (normalised estimation error squared), NIS (normalised innovation squared), whiteness of the
innovations, coverage of intervals, CRPS (continuous ranked probability score) and ranks of ensembles.
"""
