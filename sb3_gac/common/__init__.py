"""Building blocks that the algorithms share."""
