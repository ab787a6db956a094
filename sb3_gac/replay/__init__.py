"""What was seen, kept and sampled."""
