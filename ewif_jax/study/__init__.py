"""Experiments: a registry of studies, results that describe themselves, and the command line."""
