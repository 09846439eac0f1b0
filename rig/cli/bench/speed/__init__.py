"""Figures of speed, each beside what the same work costs otherwise, measured in the same run."""
