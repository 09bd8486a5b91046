"""A RealSense camera on this machine's USB as a source."""
