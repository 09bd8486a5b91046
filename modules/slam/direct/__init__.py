"""Direct RGB-D tracking: pixels and depths, without features."""
