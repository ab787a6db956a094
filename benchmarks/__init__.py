"""Programs that run algorithms on tasks and compare them. They communicate only by files, and use public names of sb3_gac."""

from importlib.util import find_spec

from sb3_gac.envs.suites.extras import missing_extra

_EXTRA = ("pandas", "plotly", "rliable", "tensorboard")


def _lacks(name: str) -> bool:
    try:
        return find_spec(name) is None
    except ImportError:
        return True


if _missing := [name for name in _EXTRA if _lacks(name)]:
    raise missing_extra("A benchmark", ", ".join(_missing), "benchmarks")
