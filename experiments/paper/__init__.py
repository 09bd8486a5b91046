"""The experiments of the paper (Sec. IV), repeated."""
