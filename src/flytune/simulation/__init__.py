"""Simulators behind one protocol, the environment, and the rollout that steps it."""

CRASH_DISTANCE = 10.0  # m from the target; a vehicle beyond it has crashed
