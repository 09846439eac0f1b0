"""The vocabulary of protocol files: quantities, waveforms, conditions, plug-in discovery."""
