"""What a method loses against the exact use of one late measurement, in expectation."""
