"""Evaluation: flights are recorded, judged and compared, whatever flew them."""
