"""Records that do not fit into memory, and those that still arrive."""
