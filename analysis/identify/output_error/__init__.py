"""Output error: the simulated model fitted to what was measured, in windows or free runs."""
