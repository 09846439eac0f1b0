"""Benches of textbook physics, written apart from simulator and analysis."""
