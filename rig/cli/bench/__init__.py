"""The performance figures behind `bramah bench`, one module per part of the program."""
