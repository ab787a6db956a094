"""How robust a trained policy is to what happens to its sensors: the parts of :mod:`sb3_gac.evaluate`."""
