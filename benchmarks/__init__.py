"""Speed beside other packages; `python -m benchmarks` prints it as a table."""
