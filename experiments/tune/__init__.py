"""Searches the values of keys that serve an objective best."""
