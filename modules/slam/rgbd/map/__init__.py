"""The map: keyframes, landmarks, and the history of both."""
