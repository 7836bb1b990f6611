"""Filters as in a textbook: pure functions of small matrices, for programs to differentiate and compile."""
