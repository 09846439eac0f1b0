"""The simulated plant: compiled equations, converters, effects."""
