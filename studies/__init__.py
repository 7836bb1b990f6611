"""Published experiments, one `authorYEAR.py` each, with the published numbers in it."""

from studies.kiki2020 import TABLE as KIKI_2020
from studies.nurhadi2022 import TABLE as NURHADI_2022

STUDIES = {table.name: table for table in (NURHADI_2022, KIKI_2020)}

__all__ = ["KIKI_2020", "NURHADI_2022", "STUDIES"]
