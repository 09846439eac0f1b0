"""What the records mean: differentiation, regressor rows, coupled identification, validation."""
