"""The catalogue: effects that the baseline model lacks, one small class each."""
