"""Readers of files that strangers wrote; nothing in such a file is run before it was inspected."""
