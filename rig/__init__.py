"""The bench: vocabulary, sessions with a device, runs on disk, command line and screen."""
