"""Clues to a residual that no effect explains: variables, formulas, frequencies."""
