"""Guided Actor-Critic, its policies, ablations and presets."""
