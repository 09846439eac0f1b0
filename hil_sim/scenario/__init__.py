"""The hidden properties of a simulated bench: its machine file, and the effects of a scenario."""
