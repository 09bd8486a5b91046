"""What a recording holds, before and while it is run."""
