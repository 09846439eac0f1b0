"""The simulated bench on a CAN bus: its side of the messages, and adapters to the bus."""
