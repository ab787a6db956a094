"""The robustness of a trained policy to disturbances of its sensors: the parts of :mod:`sb3_gac.evaluate`."""
