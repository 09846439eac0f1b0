"""Identification beside a run, and physically consistent parameters."""
