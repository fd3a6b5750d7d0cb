"""Tuning: from a wanted step response to a task, by rules and measured sensitivities."""
