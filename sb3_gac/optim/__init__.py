"""How networks and coefficients are moved: steps of optimisers, duals and other coefficients, targets, compilation, threads."""
