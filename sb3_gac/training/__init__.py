"""What the main job, :mod:`sb3_gac.train`, is made of: its options, environments and progress, and what it leaves behind."""
