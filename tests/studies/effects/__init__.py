"""Every effect of the catalogue found on a simulated bench that has it."""
