"""Rows of the regression, their triangular factors, least squares, noise and identifiability."""
