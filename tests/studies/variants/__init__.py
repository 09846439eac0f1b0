"""Further variants of the tests, too slow for every commit."""
