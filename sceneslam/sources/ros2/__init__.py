"""A robot's topics as a source: heard first, as a short recording, then followed."""
