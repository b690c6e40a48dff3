"""The maths: arrays in, arrays out; no parameters, no state."""
