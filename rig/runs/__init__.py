"""Runs on disk: recorder, journal, archive, store, recovery; rig files."""
