"""Pose graphs: measured motions between nodes, and the poses that fit them best."""
