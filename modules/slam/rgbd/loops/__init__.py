"""Places that were seen before, and the loops that they close."""
