"""Tools for saved maps: `python -m sceneslam.maps`."""
