"""Figures of the operator's screen: processor load, delay of a stop, age of its values."""
