"""The pages of the screen: plain functions that return rows of text."""
