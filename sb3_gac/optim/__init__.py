"""How training changes networks and coefficients: optimiser steps, coefficients, target networks, compilation, threads."""
