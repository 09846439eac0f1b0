"""Protocol files: schema, reading, writing, waveforms, the resolved plan."""
