"""Brute-force float64 NumPy oracles that import nothing of the package under test."""
