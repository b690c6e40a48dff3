"""An open benchmark of methods for late measurements: ``python -m benchmarks.oosm --help``."""
