"""What runs there are: a line for each, an index of them, filters."""
