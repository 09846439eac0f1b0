"""Conformance of every shipped driver with every fault of its wire at full effort."""
