"""Survey of a recording's contents, before and during a run."""
