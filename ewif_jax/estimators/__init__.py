"""In-sequence filters, one published method per file."""
