"""What is between observations and numbers: encoders, memories, heads, critics, policy networks."""
