"""The operator's screen in a browser: a server on loopback, one attached screen for each page."""
