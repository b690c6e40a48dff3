"""Estimates that also use later measurements: fixed interval, fixed lag, two-sided, batch."""
