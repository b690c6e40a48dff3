"""The same numbers from other people's code."""
