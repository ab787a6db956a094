"""What tests of a gradient step share."""

from typing import Any

from sb3_gac.base.update import Batch, Step


def steps_of(model: Any, batch: Batch) -> list[Step]:
    """What a gradient step of GAC minimises, in order, and nothing of it done yet."""
    found: list[Step] = []

    class StopHereError(Exception):
        """Instead of the steps."""

    def gather(*branches: Any) -> Any:
        found.extend(step for branch in branches for step in branch if model.policy.has(step.network))
        raise StopHereError

    model.side_by_side = gather
    try:
        model.update(batch)
    except StopHereError:
        pass
    finally:
        del model.side_by_side
    return found


def batch_of(obs: Any) -> Batch:
    """As far as the learner's loss looks at it."""
    return Batch(obs, None, None, obs, None, 0.99)
