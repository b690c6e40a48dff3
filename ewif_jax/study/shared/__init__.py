"""What several studies use: results, claims, timing, sweeps, the look of figures."""
