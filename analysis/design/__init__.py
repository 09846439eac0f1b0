"""Design of experiments: predicted standard errors, limits, better excitations."""
