"""The estimate that looks both ways against the filter and its fixed lag, on the same runs."""
