"""Faults of bench and wire: what notices each, how fast, and what the run then holds."""
