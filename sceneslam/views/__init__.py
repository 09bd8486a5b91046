"""What a camera sees of a place: features with their points, by which it is recognized again."""
