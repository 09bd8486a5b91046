"""Evidence for the table scene -> module."""
