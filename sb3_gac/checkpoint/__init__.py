"""State written to files, whole or not at all, and read back, for any algorithm."""
