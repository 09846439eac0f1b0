"""One session with a device: outputs, the guard on every sample, stops, the socket of screens."""
