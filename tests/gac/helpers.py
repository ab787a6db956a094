"""What tests of a gradient step share."""

from typing import Any

import torch as th

from sb3_gac.base.update import Batch
from sb3_gac.gac.update import StepInputs


def learner_inputs(obs: Any, kl_coef: float = 1.0, ent_coef: float = 1.0) -> StepInputs:
    """Of a gradient step, as far as the learner's loss looks at them."""
    batch = Batch(obs, None, None, obs, None, 0.99)
    return StepInputs(batch, None, None, None, th.tensor(kl_coef), th.tensor(ent_coef))
