"""Poses in the plane as transforms."""

import numpy as np

from sceneslam.types import planar


def transforms(poses):
    """Return the transforms (N, 4, 4) of poses (N, 3): x [m], y [m], yaw [rad]."""
    return np.array([planar.to_transform(pose) for pose in poses]).reshape(-1, 4, 4)
