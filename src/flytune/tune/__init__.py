"""From a wanted step response back to a task: rules, measured effects, and the loop that closes over training."""
