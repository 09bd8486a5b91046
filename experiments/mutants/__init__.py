"""Asks whether every mistake in a configuration is found before the first frame, and named."""
