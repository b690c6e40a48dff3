"""Clocks that are off, calibrated from the measurements alone."""
