"""Pornsarayouth & Yamakita, sections 5 and 6: two rotating bearing sensors, one of them late."""
