"""What one image shows: features, depth, and the shutter that read it."""
