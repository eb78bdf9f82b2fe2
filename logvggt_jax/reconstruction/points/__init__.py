"""Coloured point clouds: which pixels become points, the choice among all frames, the file."""
