"""The network: images to tokens, windows, heads, refinement."""
