"""Every wire of the simulated bench: the same parameters by each, and long streams."""
