"""Other people's worlds and interfaces: Gymnasium, Stable-Baselines3, PyBullet, MuJoCo."""
