"""Monitoring: tests on innovations, which raise an alarm when a sensor or the plant is not as assumed."""

from filters.monitoring.monitor import Alarm, Health, Monitor, Watch, tuned_monitor

__all__ = ["Alarm", "Health", "Monitor", "Watch", "tuned_monitor"]
