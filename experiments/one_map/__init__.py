"""One map of all modules and runs: what it promises, and what holds."""
