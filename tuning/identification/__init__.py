"""Identification of a plant from logs: maximum likelihood of a filter's innovations, and identifiability."""
