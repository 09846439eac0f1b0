"""The queue of runs: items on disk, and one runner that starts each as a separate process."""
