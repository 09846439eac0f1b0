"""What both ends of a serial line must agree on: frames and messages (docs/wire-serial.md)."""
