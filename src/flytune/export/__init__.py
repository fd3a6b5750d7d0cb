"""Policies for elsewhere."""
