"""Which scene the robot is in, by the votes of the detector."""
