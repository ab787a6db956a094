"""Equations as plain functions of tensors, and the distributions of actions."""
