"""How networks and coefficients are moved: optimisers' steps, coefficients, targets, compilation, threads."""
