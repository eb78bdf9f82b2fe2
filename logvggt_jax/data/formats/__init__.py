"""Pictures, numbers and lists in files, read with the damage in them named."""
