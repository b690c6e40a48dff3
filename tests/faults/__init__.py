"""One test for each kind of fault ever found, with the right value."""
