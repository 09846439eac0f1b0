"""Trace: from what the model leaves to the effect that it lacks, or to an honest refusal."""
