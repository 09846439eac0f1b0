"""What a trace works on: conditioned records, whitened residuals, noise floor, candidates."""
