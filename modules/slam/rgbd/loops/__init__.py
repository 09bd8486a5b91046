"""Places seen before: in this session, and in earlier ones."""
