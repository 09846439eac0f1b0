"""The simulated bench as a process, and all stages on it."""
