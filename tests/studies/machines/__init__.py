"""Measured machines, and a simulated electric arm."""
