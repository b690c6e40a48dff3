"""What only the methods for late measurements share."""
