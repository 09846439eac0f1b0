"""The checks of the guard: bands, rates, saturation, plausibility, each over whole blocks."""
