"""The page of a suite's results: one file of HTML that needs nothing else."""
