"""Adjustment of the map: bundles, constraints, new landmarks."""
