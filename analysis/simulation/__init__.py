"""The identified model as data, and its simulation: free run, twin, validation."""
