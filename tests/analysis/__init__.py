"""Tests of the analysis against independent routes."""
