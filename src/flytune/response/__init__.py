"""How a flight is judged: trials are flown, measured and summarised, whoever the pilot was."""
