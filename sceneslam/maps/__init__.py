"""Looks after saved maps: `python -m sceneslam.maps`."""
