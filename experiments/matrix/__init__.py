"""Every story of the simulator under every strategy."""
