"""The operator's actions: command a run, start verbs, move a joint by hand."""
