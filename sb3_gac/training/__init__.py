"""Parts of the main job, :mod:`sb3_gac.train`: its options, environments, progress and results."""
