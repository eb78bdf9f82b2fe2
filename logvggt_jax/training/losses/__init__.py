"""The objectives, on targets in the network's units, and the errors that are logged beside them."""
