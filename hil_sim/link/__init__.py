"""The link between host and simulated device, with faults of frames."""
