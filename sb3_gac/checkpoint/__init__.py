"""State as files, whole or not at all, and back; it knows of no algorithm."""
