"""Speed measurements: workloads, peers and timing. Run with ``python -m benchmarks.<name>``."""
