"""Floor plans, and finding one in another."""
