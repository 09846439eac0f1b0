"""Benches of textbook physics, written apart from simulator and analysis, and what is made of them."""
