"""Benchmark of injected faults: detection, delay of detection, and loss of samples."""
