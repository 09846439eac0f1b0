"""The simulated bench: a plant with more detailed physics than the analysis, behind a wire."""
