"""Guided Actor-Critic, its policies and ablations."""
