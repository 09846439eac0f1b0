"""What both ends of a serial line or a CAN bus must agree on: frames and messages."""
