"""The vocabulary shared by all layers: quantities, rig, channels, records; no I/O, no devices."""
