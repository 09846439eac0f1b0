"""The wire between host and simulated device as a place of its own, where frames are spoiled."""
