"""Published experiments, one `authorYEAR.py` each, with the published numbers in it."""
