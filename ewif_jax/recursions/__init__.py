"""The two recursions that several published filters share, each written once."""
