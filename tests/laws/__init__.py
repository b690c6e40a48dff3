"""What is true of the methods: one claim a file."""
