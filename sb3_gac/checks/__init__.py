"""Checks of what users and environments hand in, before it does harm; each error names the culprit and the remedy."""
