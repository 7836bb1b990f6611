"""Filters as C99 for a controller: no heap, no recursion, no library but math.h.

programs     a page's functions as programs, with the numbers of a model in them; the error of single precision
writer       NAME.h and NAME.c of these, of a mean and covariance or of an ensemble
monitor      tests of the innovations in them
project      a folder with these, a class of C++ around them, their sizes, and how to build them
log_program  a program that filters a log; log_reader reads its rows

The text is that of the programs that machine code is made of; only the place of a number differs. The model's
numbers are constants there: zeros vanish, and a step takes a third to a half of the time. The price is a new
export for another Q.
"""
