"""Damaged frames and files by the million: no crash, no hang, no memory without bound."""
