"""Configuration: TOML to dataclasses and back, and files that are whole or absent."""
