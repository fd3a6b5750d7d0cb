"""What is wanted: reward, terminations, observation, initial states, and the task that holds them."""
