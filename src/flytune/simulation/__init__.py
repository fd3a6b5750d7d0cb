"""Simulators behind one protocol, the environment, and the rollout that steps it."""
