"""What is true of a simulated bench: its machine file, and the effects that a scenario hides."""
