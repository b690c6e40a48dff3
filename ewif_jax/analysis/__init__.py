"""What a filter is worth: merit of late data, bounds, actual errors, consistency, equivalences."""
