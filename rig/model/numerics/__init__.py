"""Computations on arrays that more than one layer needs: spectra, the matrix exponential."""
