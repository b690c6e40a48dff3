"""What every estimator promises, whatever it computes."""
