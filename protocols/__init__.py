"""Protocols: the steps of an experiment and their order (lock, excite, repeat)."""
