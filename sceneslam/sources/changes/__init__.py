"""Sources that wrap another one and change what it gives."""
