"""Figures of speed, each with the time of a reference program, measured in the same run."""
