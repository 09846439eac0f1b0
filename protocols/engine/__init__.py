"""Running a plan on a bench: placing, locking, centring, playing waveforms, recording."""
