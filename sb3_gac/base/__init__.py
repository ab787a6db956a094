"""What all algorithms with a privileged view share."""
