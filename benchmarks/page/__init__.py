"""The page of a suite's results: one HTML file that needs no other file."""
