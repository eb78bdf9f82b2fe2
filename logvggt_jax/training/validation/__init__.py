"""Accuracy on fixed clips that training never sees, and its pictures."""
