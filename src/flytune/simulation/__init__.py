"""Simulators behind one protocol, the environment, and the rollout that steps it."""

# m from the target; a vehicle beyond it has crashed. A start beyond half of it doubles its own distance
CRASH_DISTANCE = 10.0
