"""Identification of a plant from logs: maximum likelihood of a filter's innovations, and identifiability."""

from tuning.identification.identify import identify
from tuning.identification.profiles import Profile, profile_figure, profiles
from tuning.identification.result import Identification
from tuning.identification.validation import Validation, validate

__all__ = ["Identification", "Profile", "Validation", "identify", "profile_figure", "profiles", "validate"]
