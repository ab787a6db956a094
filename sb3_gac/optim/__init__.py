"""How networks and coefficients are moved: flat parameters, optimisers, duals, compilation, threads."""
