"""The algorithms that GAC is compared with, each in a file of its own."""
