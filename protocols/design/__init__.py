"""Protocols proved and generated: check on the twin, candidates, selection, sizing."""
