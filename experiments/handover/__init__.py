"""What a hand-over between two modules loses."""
