"""Checks of a copy of a data set, their report and picture, and what each set is."""
