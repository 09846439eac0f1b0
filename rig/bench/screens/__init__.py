"""What screens see of a run: snapshots, published over local sockets of their owner only."""
