"""The vocabulary every layer shares: quantities, rig, channels, records; no I/O, no devices."""
