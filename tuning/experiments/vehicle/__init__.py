"""Two papers on the estimation of an underwater vehicle's path, repeated with many runs.

`papers` has what they print and their model of the vehicle, `estimators` the filters of each study. `experiment`
runs all of them on the same runs, `tables` has the printed values beside ours, and the conclusions.
"""
