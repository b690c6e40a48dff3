"""Filters in continuous time, whose measurements are a signal."""
