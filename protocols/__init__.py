"""What to do on the bench, in what order: lock, excite, repeat."""
