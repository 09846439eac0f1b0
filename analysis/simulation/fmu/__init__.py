"""A model as a functional mock-up unit: C source, model description, archive."""
