"""The simulated bench: a plant with finer physics than the analysis, at the far end of a wire."""
