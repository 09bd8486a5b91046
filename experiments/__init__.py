"""Experiments: questions that take many runs, each with its command and its numbers."""
