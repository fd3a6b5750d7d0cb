"""Showing: judged flights become figures and one page to read."""
