"""Trainers: proximal policy optimisation and the gradient of the simulator."""
