"""Alarms: the bands a rig file sets, and the states an alarm goes through."""
