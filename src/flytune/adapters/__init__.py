"""Interfaces of other projects: Gymnasium, Stable-Baselines3, and a picture."""
