"""Shared parts of live sources: clocks, monitoring of streams, and queues."""
