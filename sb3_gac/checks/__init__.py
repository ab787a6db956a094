"""What users and environments hand in, looked at before it does harm; each error names the culprit and the remedy."""
