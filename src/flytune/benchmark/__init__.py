"""Throughput on this machine, and that of the baselines: Stable-Baselines3 and PyBullet."""
