"""Figures of the operator's screen: its cost, its stop, the age of its numbers."""
