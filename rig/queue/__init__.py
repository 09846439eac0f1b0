"""A night's work: items on disk, one runner that starts each as a process of its own."""
