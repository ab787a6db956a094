"""The train loop, and what a gradient step is put together from."""

import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeAlias

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gac.base.faults import FaultTolerance
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.divergence import check_finite_metrics
from sb3_gac.math.distributions import Distribution
from sb3_gac.math.losses import critic_loss, masked_mean
from sb3_gac.networks.actors import RolePolicy
from sb3_gac.optim.compile import Program, Staged, StagedProgram, compilable_in_stages
from sb3_gac.optim.parallel import halved_threads, run_halves
from sb3_gac.replay.episodes import EpisodeReplayBuffer, SequenceSamples

Metrics = dict[str, th.Tensor]


class Batch(NamedTuple):
    r"""
    A batch of transitions, ``*E`` = (B,), or of sequences of them from episodes' starts on, ``*E`` = (T, B).

    :param observations: dict of entries, (\*E, ...) of each
    :param actions: in [-1, 1], shape (\*E, A), or numbers of actions, shape (\*E, 1)
    :param rewards: shape (\*E)
    :param next_observations: dict of entries, (\*E, ...) of each
    :param dones: 1 where the episode terminated, 0 where it went on or ran into its time limit, shape (\*E)
    :param discounts: gamma to the number of steps that the reward sums up, scalar or shape (\*E)
    :param sequence: of sequences, observations and the last next one together, (T + 1, B, ...) of each entry
    :param mask: of sequences, 1 for what counts, 0 for padding and for what only brings memories up, shape (T, B)
    """

    observations: PyTorchObs
    actions: th.Tensor
    rewards: th.Tensor
    next_observations: PyTorchObs
    dones: th.Tensor
    discounts: th.Tensor
    sequence: PyTorchObs | None = None
    mask: th.Tensor | None = None

    def outputs(self, policy: RolePolicy) -> tuple[Any, Any]:
        """
        :param policy: a policy's network
        :return: its distribution for the observations, and, as a constant, for the next ones; for sequences in one pass
        """
        if self.sequence is None:
            now = policy.distribution(self.observations)
            with th.no_grad():
                return now, policy.distribution(self.next_observations)
        both: Any = policy.distribution(self.sequence)
        return type(both)(*(part[:-1] for part in both)), type(both)(*(part[1:].detach() for part in both))

    @th.no_grad()
    def values_at(self, critic: Any) -> Callable[[Any], th.Tensor]:
        """
        :param critic: an ensemble, frozen
        :return: actions at the observations -> values, differentiable by the actions
        """
        return partial(critic.values, critic.encode(self.observations))

    @th.no_grad()
    def values_after(self, critic: Any) -> Callable[[Any], th.Tensor]:
        """
        :param critic: an ensemble, frozen
        :return: actions at the next observations -> values
        """
        if self.sequence is None:
            return partial(critic.values, critic.encode(self.next_observations))
        return partial(critic.values, critic.encode(self.sequence)[:, 1:])


class Descent(NamedTuple):
    """
    What a loss asks of a network.

    :param gradient: with respect to its flat parameters
    :param metrics: loss, gradient norm and whatever else is to be logged, detached
    """

    gradient: th.Tensor
    metrics: Metrics


class Slope(NamedTuple):
    """
    What a loss asks of a policy's outputs.

    :param gradient: with respect to them, in their structure
    :param metrics: loss and whatever else is to be logged, detached
    """

    gradient: Distribution
    metrics: Metrics


#: A policy's backward pass: gradient with respect to its outputs -> with respect to its flat parameters, and that one's norm
Backward: TypeAlias = Callable[[Distribution], tuple[th.Tensor, th.Tensor]]


def as_leaves(outputs: Any) -> Any:
    """
    :param outputs: of a policy, constants
    :return: the same, to be differentiated by
    """
    return type(outputs)(*(part.detach().requires_grad_() for part in outputs))


def gradient_of(loss: th.Tensor, outputs: Any) -> Any:
    """
    :param loss: scalar
    :param outputs: of a policy, see :func:`as_leaves`
    :return: the loss's gradient with respect to each
    """
    return type(outputs)(*th.autograd.grad(loss, outputs, allow_unused=True, materialize_grads=True))


class NetworkTraining(FaultTolerance):
    """
    ``train`` for networks that are laid out flat, each with its optimiser: a subclass writes one gradient step.

    The attributes below are those of :class:`sb3_gac.base.off_policy.AsymmetricOffPolicyAlgorithm`.
    """

    #: Arguments that a compiled part takes for constants: a change compiles it anew
    compiled_settings: ClassVar[tuple[str, ...]] = ("max_grad_norm", "mixed_precision")
    policy: AsymmetricPolicy
    tau: float
    target_update_interval: int
    max_grad_norm: float | None
    compile: bool
    mixed_precision: bool
    programs: dict[Any, Program | StagedProgram]
    program_key: tuple[Any, ...]
    _halves_are_independent: bool
    _halves_together = False
    #: Of the last round of gradient steps, all finite
    _last_metrics: Mapping[str, float] = MappingProxyType({})
    _waiting = False

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        :param gradient_steps: number of gradient steps
        :param batch_size: transitions per step, B
        """
        if self._waits_for_an_episode():
            return
        self.policy.set_training_mode(True)
        self.policy.refresh_parameters()
        self._update_learning_rate(self._scheduled_optimizers())
        settings = (getattr(self, name) for name in self.compiled_settings)
        self.program_key = (batch_size, self.policy, self.policy.frozen, *settings)
        self._halves_together = self._halves_are_independent and th.get_num_threads() > 1
        with halved_threads(self._halves_together):
            history = [self._one_update(batch_size, diagnose=left == 1) for left in range(gradient_steps, 0, -1)]
        self._record_metrics(history)

    def _waits_for_an_episode(self) -> bool:
        """Whether there is nothing yet to learn from; said once. (A full buffer without a whole episode is an error.)"""
        buffer = self.replay_buffer
        waits = isinstance(buffer, EpisodeReplayBuffer) and not buffer.full and buffer.n_episodes == 0
        if waits and not self._waiting:
            warnings.warn(
                "There are no gradient steps until the first episode has ended, although "
                f"learning_starts={self.learning_starts} is over: a recurrent policy learns from whole episodes.",
                stacklevel=3,
            )
        self._waiting = waits
        return waits

    def _one_update(self, batch_size: int, diagnose: bool) -> Metrics:
        metrics = self._gradient_step(self._sample_batch(batch_size), diagnose)
        self._n_updates += 1
        if self._n_updates % self.target_update_interval == 0:
            self.policy.update_targets(self.tau)
        return metrics

    def _run_halves(self, tasks: Sequence[Callable[[], Any]]) -> list[Any]:
        """
        :param tasks: independent of each other, see :func:`run_halves`
        :return: their results
        """
        return run_halves(tasks, self._halves_together)

    def _critic_descent(self, name: str, batch: Batch, target: th.Tensor) -> Descent:
        """
        An ensemble's way towards its Bellman targets.

        :param name: attribute of the policy
        :param batch: B transitions
        :param target: shape (B,)
        :return: with loss, mean Q and gradient norm, named after the ensemble
        """
        q = getattr(self.policy, name)(batch.observations, batch.actions)
        loss = critic_loss(q, target, batch.mask)
        gradient, norm = self.policy.flat_parameters[name].gradient(loss, self.max_grad_norm)
        mean_q = masked_mean(q.detach().mean(dim=0), batch.mask)
        return Descent(gradient, {f"{name}_q": mean_q, f"{name}_loss": loss.detach(), f"{name}_grad_norm": norm})

    @compilable_in_stages
    def _policy_pass(self, name: str, batch: Batch) -> Staged:
        """
        A policy's forward pass, to which its backward pass belongs: call it for the outputs and a :data:`Backward`.

        :param name: attribute of the policy
        :param batch: B transitions
        """
        now, later = batch.outputs(getattr(self.policy, name))
        slopes = yield now.detach(), later
        yield self.policy.flat_parameters[name].gradient(now, self.max_grad_norm, slopes)

    def _policy_step(self, name: str, backward: Backward, slope: Slope) -> Metrics:
        """
        One step of a policy's optimiser.

        :param name: attribute of the policy
        :param backward: pass of that policy
        :param slope: of its loss
        :return: metrics, with the gradient norm
        """
        gradient, norm = backward(slope.gradient)
        return self._step(name, Descent(gradient, {**slope.metrics, f"{name}_grad_norm": norm}))

    def _step(self, name: str, descent: Descent) -> Metrics:
        """
        One step of a network's optimiser.

        :param name: attribute of the policy
        :param descent: of that network
        :return: its metrics
        """
        flat_parameters = self.policy.flat_parameters[name]
        if flat_parameters.parameters:  # unless all are frozen
            flat_parameters.flat.grad = descent.gradient
            getattr(self.policy, name).optimizer.step()
        return descent.metrics

    @abstractmethod
    def _gradient_step(self, batch: Batch, diagnose: bool = True) -> Metrics:
        """
        One update of all networks but the targets.

        :param batch: B transitions
        :param diagnose: whether to add what costs extra, as on the last of a round
        :return: detached tensors of shape () to log under "train/", left on the device
        """

    def _sample_batch(self, batch_size: int) -> Batch:
        assert self.replay_buffer is not None
        samples = self.replay_buffer.sample(batch_size, env=self.sampling_env)
        discounts = getattr(samples, "discounts", None)
        if discounts is None:
            discounts = th.full((), self.gamma, device=self.device)
        if isinstance(samples, SequenceSamples):
            now = {key: entry[:-1] for key, entry in samples.observations.items()}
            later = {key: entry[1:] for key, entry in samples.observations.items()}
            what_happened = (samples.actions, samples.rewards, later, samples.dones)
            return Batch(now, *what_happened, discounts, samples.observations, samples.mask)
        return Batch(
            samples.observations,
            samples.actions,
            samples.rewards.flatten(),
            samples.next_observations,
            samples.dones.flatten(),
            discounts.flatten() if discounts.dim() else discounts,
        )

    @abstractmethod
    def _dual_names(self) -> list[str]:
        """Attributes that hold coefficients."""

    @abstractmethod
    def _scheduled_optimizers(self) -> list[th.optim.Optimizer]:
        """Optimisers that follow ``learning_rate``."""

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        """Follow the schedule; a parameter group's "lr_scale" multiplies it."""
        super()._update_learning_rate(optimizers)
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            for group in optimizer.param_groups:
                group["lr"] *= group.get("lr_scale", 1.0)

    def _record_metrics(self, history: list[Metrics]) -> None:
        """
        Log means over the gradient steps of one ``train()``, and diagnostics of the last: the only host transfer.

        :param history: of each gradient step
        :raises DivergenceError: if a metric is not finite
        """
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if not history:
            return
        names, last = list(history[0]), history[-1]
        means = th.stack([th.stack([step[name] for name in names]) for step in history]).mean(dim=0)
        diagnostics = [name for name in last if name not in names]
        means = th.cat([means, *(last[name].reshape(1) for name in diagnostics)])
        values = dict(zip([*names, *diagnostics], means.tolist(), strict=True))
        values["actor_loss"] = values[f"{self.policy.roles.deployed}_loss"]  # SB3's names for the two
        values["critic_loss"] = sum(value for name, value in values.items() if name.endswith("critic_loss"))
        for name, value in values.items():
            self.logger.record(f"train/{name}", value)
        coefficients = {name.removesuffix("_dual"): getattr(self, name).value for name in self._dual_names()}
        check_finite_metrics(self, values, self._last_metrics, coefficients)
        self._last_metrics = values
