"""The simulated device: sample clock, output laws, register map, server."""
