"""
Simulators that step many environments at once, as SB3's ``VecEnv``.

:func:`~sb3_gac.envs.vector.registry.make_vec` makes any registered environment;
:class:`~sb3_gac.envs.vector.base.BatchVecEnv` is the base class for simulators that step a batch.  These modules import SB3,
and SB3 imports torch; the wrappers import neither.
"""
