"""What tests of a gradient step share."""

from collections.abc import Callable
from typing import Any, NamedTuple

from sb3_gac.base.batch import Batch, Loss, Metrics


class Step(NamedTuple):
    """What is handed to ``minimize``."""

    network: str
    loss: Callable[..., Loss]
    tensors: tuple[Any, ...]


def steps_of(model: Any, batch: Batch) -> list[Step]:
    """What a gradient step of GAC minimises, in order, and nothing of it done yet."""
    found: list[Step] = []

    class StopHereError(Exception):
        """Instead of the steps."""

    def note(network: str, loss: Callable[..., Loss], *tensors: Any) -> Metrics:
        found.append(Step(network, loss, tensors))
        return {}

    def stop(beside: Callable[[], Metrics], here: Callable[[], Metrics]) -> Metrics:
        beside()
        here()
        raise StopHereError

    model.minimize, model.in_branches = note, stop
    try:
        model.update(batch)
    except StopHereError:
        pass
    finally:
        del model.minimize, model.in_branches
    return [step for step in found if model.policy.has(step.network)]


def batch_of(obs: Any) -> Batch:
    """As far as the learner's loss looks at it."""
    return Batch(obs, None, None, obs, None, 0.99)
