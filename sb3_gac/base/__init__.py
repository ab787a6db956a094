"""The parts that all algorithms with a privileged view share."""
