"""The training step: state, optimiser, what is frozen, the program that a run's settings ask for and what it costs."""
