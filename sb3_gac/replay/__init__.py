"""Replay buffers: how observations are stored and sampled."""
