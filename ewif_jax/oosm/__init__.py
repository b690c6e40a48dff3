"""Late measurements: one published method per file."""
