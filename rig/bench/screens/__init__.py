"""Snapshots of a run for screens, published over local sockets that only their owner can open."""
