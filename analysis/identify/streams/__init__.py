"""Identification from records that do not fit into memory, and during recording."""
