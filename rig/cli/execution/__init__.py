"""The work of verbs that connect to a bench."""
