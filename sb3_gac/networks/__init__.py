"""Networks: encoders, memories, heads, critics and policy networks."""
