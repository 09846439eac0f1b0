"""Following a run: what it publishes becomes frames, a history and a log."""
