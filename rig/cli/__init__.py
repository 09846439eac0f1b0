"""The command line. Only this package and `rig.tui` print."""
