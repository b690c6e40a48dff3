"""Targets that manoeuvre, seen late: one filter that forgets, one that is noisy, and a mixture."""
