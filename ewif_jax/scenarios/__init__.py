"""Worlds to test filters in."""
