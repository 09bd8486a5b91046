"""Comparison of runs on one page."""
