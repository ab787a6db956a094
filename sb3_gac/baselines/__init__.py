"""The algorithms that GAC is compared with, one small class a file."""
