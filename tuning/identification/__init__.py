"""Identification of a plant from logs: maximum likelihood of a filter's innovations, and identifiability."""

from tuning.identification.identify import identify
from tuning.identification.profiles import Profile, Validation, profile_figure, profiles, validate
from tuning.identification.result import Identification

__all__ = ["Identification", "Profile", "Validation", "identify", "profile_figure", "profiles", "validate"]
