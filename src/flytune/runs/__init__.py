"""Run directories, the policies that ship, and controllers by name."""
