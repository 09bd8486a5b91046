"""Submaps, and the graph between them."""
