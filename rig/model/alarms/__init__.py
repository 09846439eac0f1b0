"""Alarms: the bands of a rig file, and the states of an alarm."""
