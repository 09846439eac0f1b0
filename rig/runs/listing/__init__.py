"""Lists of runs: summaries, their index, filters."""
