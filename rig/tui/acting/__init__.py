"""What the operator can do: command a run, start verbs, move a joint by hand."""
