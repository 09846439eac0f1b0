"""Damaged journals: detection, reading of the intact part, and rebuilding."""
