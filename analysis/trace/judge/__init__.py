"""Judgement of a named effect: gates, intervals, invariance, error on held-out records."""
