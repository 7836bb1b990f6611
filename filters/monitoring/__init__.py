"""Monitoring: tests on innovations, which raise an alarm if a sensor or the plant deviates from the model."""

from filters.monitoring.monitor import Alarm, Health, Monitor, Watch, tuned_monitor

__all__ = ["Alarm", "Health", "Monitor", "Watch", "tuned_monitor"]
