"""Rows of styled text and their elements: plots, bars, boxes, large letters."""
