"""Stages of a trace: preparation, search, conclusion, rows of other bandwidths."""
