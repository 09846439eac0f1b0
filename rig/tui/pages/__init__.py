"""The pages of the screen: plain functions from what is known to rows of text."""
