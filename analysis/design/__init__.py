"""Experiments before they run: predicted standard errors, limits, better excitations."""
