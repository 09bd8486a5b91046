"""Whether a module tracks, and whether its motion is believed."""
