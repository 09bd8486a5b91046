"""Maps that are saved and loaded."""
