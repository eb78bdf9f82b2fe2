"""`logvggt doctor`: what a machine has, whether the model computes right on it, and how fast."""
