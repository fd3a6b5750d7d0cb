"""How a policy is found: proximal policy optimisation, or the gradient of the simulator itself."""
