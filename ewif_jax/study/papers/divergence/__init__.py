"""Data saturation, section 4 of Anderson (1973): a filter that trusts a constant too long, and
three remedies."""
