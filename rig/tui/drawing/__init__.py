"""Rows of styled text and what is drawn with them: plots, bars, boxes, large letters."""
