"""The simulated bench on a CAN bus: its side of the messages, and the adapters to the bus."""
