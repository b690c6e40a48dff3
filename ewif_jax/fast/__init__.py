"""What exists only because compilers are slow at small arrays; it knows no filter and no model."""
