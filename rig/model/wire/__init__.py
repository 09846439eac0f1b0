"""Definitions shared by both ends of a serial line or a CAN bus: frames and messages."""
