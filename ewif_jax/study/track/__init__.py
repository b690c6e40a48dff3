"""The command `ewif-jax track`: a filter over the measurements in a CSV file."""
