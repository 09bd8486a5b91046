"""What happened in a run, in sentences and as one page."""
