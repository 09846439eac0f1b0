"""Following a run: its published data become frames, a history and a log."""
