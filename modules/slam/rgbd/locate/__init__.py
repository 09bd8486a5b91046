"""The camera in the map: matching, the pose, and what it is worth."""
