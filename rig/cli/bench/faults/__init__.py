"""Bench of injected faults: what is noticed, how fast, and that nothing is lost."""
