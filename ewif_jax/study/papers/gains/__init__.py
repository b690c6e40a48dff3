"""Figs. 1-3 of Yoder et al.: what an old measurement still weighs when they come irregularly; and
what the one-step methods make of it."""
