"""Orguner & Gustafsson, section IV: particle filters, a fast turn, and a late third sensor."""
