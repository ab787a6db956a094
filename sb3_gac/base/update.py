"""The train loop, and the one primitive that a gradient step is put together from: ``minimize``."""

import warnings
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gac.base.faults import FaultTolerance
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import resolve_update_every
from sb3_gac.checks.divergence import check_finite_metrics
from sb3_gac.math.losses import critic_loss, masked_mean, soft_target
from sb3_gac.networks.actors import RolePolicy
from sb3_gac.optim.coefficients import Coefficient
from sb3_gac.optim.compile import Program
from sb3_gac.optim.parallel import halved_threads, run_side_by_side
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.episodes import EpisodeReplayBuffer, SequenceSamples
from sb3_gac.replay.histories import Histories

#: Name -> detached scalar, left on the device
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
    :param histories: of transitions, what came before each, if the algorithm's :attr:`NetworkTraining.history_length` asks
        for it
    """

    observations: PyTorchObs
    actions: th.Tensor
    rewards: th.Tensor
    next_observations: PyTorchObs
    dones: th.Tensor
    discounts: th.Tensor
    sequence: PyTorchObs | None = None
    mask: th.Tensor | None = None
    histories: Histories | None = None

    def outputs(self, policy: RolePolicy) -> "Outputs":
        """
        :param policy: a policy's network
        :return: its distributions for the observations and, as constants, for the next ones; with a memory in one pass
        """
        if policy.memory is None:
            now = policy.distribution(self.observations)
            with th.no_grad():
                return Outputs(now, policy.distribution(self.next_observations))
        both: Any = policy.distribution(self.sequence)  # type: ignore[arg-type]
        return Outputs(type(both)(*(part[:-1] for part in both)), type(both)(*(part[1:].detach() for part in both)))

    def soft_target(self, next_q: th.Tensor, reward: th.Tensor | None = None, **terms: th.Tensor | float) -> th.Tensor:
        r"""
        The Bellman target of these transitions.

        :param next_q: target critics at the next observations, shape (N, \*E)
        :param reward: in place of the batch's, shape (\*E)
        :param terms: of :func:`sb3_gac.math.losses.soft_target`: entropy and KL at the next observations, and their weights
        :return: shape (\*E)
        """
        reward = self.rewards if reward is None else reward
        return soft_target(reward=reward, done=self.dones, next_q=next_q, discount=self.discounts, **terms)

    @th.no_grad()
    def q_at_obs(self, critic: Any) -> Callable[[Any], th.Tensor]:
        """
        :param critic: an ensemble, frozen
        :return: actions at the observations -> values, differentiable by the actions
        """
        return partial(critic.values, critic.encode(self.observations))

    @th.no_grad()
    def q_at_next_obs(self, critic: Any) -> Callable[[Any], th.Tensor]:
        """
        :param critic: an ensemble, frozen
        :return: actions at the next observations -> values
        """
        if critic.memory is None:
            return partial(critic.values, critic.encode(self.next_observations))
        return partial(critic.values, critic.encode(self.sequence)[:, 1:])


class Outputs(NamedTuple):
    """
    What a policy's network computes for a batch.

    :param now: for the observations, with its gradient
    :param later: for the next observations, constant
    """

    now: Any
    later: Any


class Loss(NamedTuple):
    """
    :param value: what a network minimises, scalar
    :param metrics: what else is to be logged, or is needed for the coefficients, scalars
    """

    value: th.Tensor
    metrics: Metrics


class Step(NamedTuple):
    """
    A step down a loss, for :meth:`NetworkTraining.side_by_side`.

    :param network: see :meth:`NetworkTraining.minimize`
    :param loss: see there
    :param tensors: see there
    """

    network: str
    loss: Callable[..., Loss]
    tensors: tuple[Any, ...]


class NetworkTraining(FaultTolerance):
    """
    ``train`` for the networks of a policy and their coefficients: a subclass writes one ``update``, made of ``minimize``.

    What changes from step to step must be a tensor: an argument of a loss, a parameter or a coefficient's value. Numbers that
    a loss finds on ``self`` are named in ``compiled_settings``. The attributes below are those of
    :class:`sb3_gac.base.off_policy.AsymmetricOffPolicyAlgorithm`.
    """

    #: Arguments that a compiled update takes for constants: a change compiles it anew
    compiled_settings: ClassVar[tuple[str, ...]] = ("max_grad_norm", "mixed_precision")
    policy: AsymmetricPolicy
    coefficients: dict[str, Coefficient]
    tau: float
    target_update_interval: int
    max_grad_norm: float | None
    compile: bool
    mixed_precision: bool
    policy_delay: int
    update_every: Mapping[str, int] | None
    programs: dict[Any, Program]
    _branches_are_independent: bool
    _at_once = False
    _program_key: tuple[Any, ...] = ()
    #: Networks that the gradient step under way leaves as they are, see ``update_every``
    _resting: frozenset[str] = frozenset()
    #: Of the last round of gradient steps, all finite
    _last_metrics: Mapping[str, float] = MappingProxyType({})
    _waiting = False

    # --- what an algorithm writes, and what it writes it with ---------------------------------------------------------

    @property
    def history_length(self) -> int:
        """Steps before each transition that the batches of the next gradient steps have, see ``Batch.histories``."""
        return 0

    @property
    def at_rest(self) -> frozenset[str]:
        """Networks that the next gradient steps leave as they are, whatever is minimised: those of another phase."""
        return frozenset()

    @abstractmethod
    def update(self, batch: Batch) -> Metrics:
        """
        One gradient step of all networks and coefficients; targets follow by themselves.

        :param batch: B transitions
        :return: to log under "train/"
        """

    def minimize(self, networks: str | tuple[str, ...], loss: Callable[..., Loss], *tensors: Any) -> Metrics:
        """
        One step of a network's optimiser down a loss, for which all other networks are constants.

        :param networks: name of one, or of several that share a loss, each with its own optimiser and bound on its gradient
        :param loss: function of the tensors
        :param tensors: in tuples or dicts; what changes from step to step
        :return: the loss under the (first) network's name, the norms of the gradients, and the loss's metrics
        """
        names = (networks,) if isinstance(networks, str) else networks
        with self._precision():
            value, metrics = loss(*tensors)
        metrics = {name: metric.detach() for name, metric in {f"{names[0]}_loss": value, **metrics}.items()}
        trained = {name: self.policy.trained[name] for name in names if name not in self._resting}
        parameters = [parameter for network in trained.values() for parameter in network.parameters]
        gradients: Sequence[th.Tensor] = ()
        if parameters and value.requires_grad:
            gradients = th.autograd.grad(value, parameters, allow_unused=True, materialize_grads=True)
        for name, network in trained.items():
            own, gradients = gradients[: len(network.parameters)], gradients[len(network.parameters) :]
            metrics[f"{name}_grad_norm"] = network.step(own, self.max_grad_norm)
        return metrics

    def side_by_side(self, *branches: Sequence[Step]) -> Metrics:
        """
        The same as ``minimize`` for each step of each branch; branches may run at once.

        :param branches: no step of one changes what a step of another reads, but for what was computed before; steps of
            networks that an ablation does without are left out
        :return: metrics of all steps
        """
        branches = tuple([step for step in branch if self.policy.has(step.network)] for branch in branches)
        if not self._at_once:
            steps = [step for branch in branches for step in branch]
            return _joined([self.minimize(step.network, step.loss, *step.tensors) for step in steps])
        return _joined(run_side_by_side([partial(self._run_branch, branch) for branch in branches]))

    def _run_branch(self, branch: Sequence[Step]) -> Metrics:
        def run(*tensors: Any) -> Metrics:
            return _joined([self.minimize(s.network, s.loss, *own) for s, own in zip(branch, tensors, strict=True)])

        name = tuple(step.network for step in branch)
        tensors = [step.tensors for step in branch]
        return self._compiled(name, run, *tensors) if self.compile else run(*tensors)

    def outputs(self, batch: Batch, *roles: str) -> list[Outputs]:
        """
        Forward passes of policies, before any network is changed.

        :param batch: of transitions
        :param roles: names of the policies
        """

        passes = [partial(self._outputs_of, role, batch) for role in roles]
        return run_side_by_side(passes) if self._at_once and len(roles) == 2 else [one() for one in passes]

    def _outputs_of(self, role: str, batch: Batch) -> Outputs:
        def run(batch: Batch) -> Outputs:
            with self._precision():
                return batch.outputs(getattr(self.policy, role))

        if not self._in_several_programs:
            return run(batch)
        with th.no_grad():
            return self._compiled(role, run, batch)

    def now(self, role: str, outputs: Outputs, batch: Batch) -> Any:
        """
        What a loss differentiates by.

        :param role: a policy
        :param outputs: what :meth:`outputs` returned of it
        :param batch: that was computed for
        :return: its distributions for the observations, with their gradient, which does not pass from program to program
        """
        if not self._in_several_programs:
            return outputs.now
        return getattr(self.policy, role).distribution(batch.observations)

    def bellman_loss(self, name: str, batch: Batch, target: th.Tensor) -> Loss:
        r"""
        :param name: of the critics
        :param batch: of transitions
        :param target: Bellman target, shape (\*E)
        :return: squared Bellman residual, with the mean Q
        """
        q = getattr(self.policy, name)(batch.observations, batch.actions)
        return Loss(critic_loss(q, target, batch.mask), {f"{name}_q": masked_mean(q.detach().mean(dim=0), batch.mask)})

    def coefficient_values(self) -> Metrics:
        """To be logged: name -> value, the mean over dimensions where there are several."""
        return {name: coefficient.value.mean() for name, coefficient in self.coefficients.items()}

    # --- the loop -----------------------------------------------------------------------------------------------------

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        :param gradient_steps: number of gradient steps
        :param batch_size: transitions per step, B
        """
        if self._waits_for_an_episode():
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self._scheduled_optimizers())
        self.policy.refresh_parameters(self.compile)
        self.refresh_schedules()
        self._at_once = self._branches_are_independent and th.get_num_threads() > 1
        settings = (getattr(self, name) for name in self.compiled_settings)
        self._program_key = (self.policy, self.policy.optimizer_options, th.get_num_threads(), *settings)
        update_every = resolve_update_every(self.policy.roles, self.policy_delay, self.update_every)
        at_rest = self.at_rest
        for name in at_rest:
            getattr(self.policy, name).train(False)
        targets_follow = not set(self.policy.pairs) <= at_rest
        history: list[Metrics] = []
        with halved_threads(self._at_once):
            for _ in range(gradient_steps):
                batch = self._sample_batch(batch_size)
                self._resting = at_rest.union(name for name, every in update_every.items() if self._n_updates % every)
                whole = self.compile and not self._in_several_programs
                history.append(self._compiled("update", self.update, batch) if whole else self.update(batch))
                self._n_updates += 1
                if targets_follow and self._n_updates % self.target_update_interval == 0:
                    self.policy.update_targets(self.tau)
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

    @property
    def _in_several_programs(self) -> bool:
        """Whether each branch is compiled by itself."""
        return self.compile and self._at_once

    def _compiled(self, name: Any, function: Callable[..., Any], *args: Any) -> Any:
        """
        :param name: of the function
        :param function: of tensors, and of what the key says of this object
        :param args: its arguments
        :return: its value, by a program of its own for all that the key says
        """
        key = (name, self._resting, *self._program_key, *_layout(args))
        if key not in self.programs:
            self.programs[key] = Program(function, self.device)
        return self.programs[key](*args)

    def _precision(self) -> AbstractContextManager:
        if self.mixed_precision:
            return th.autocast(self.device.type, th.bfloat16, cache_enabled=False)
        return nullcontext()

    def _sample_batch(self, batch_size: int) -> Batch:
        buffer, histories = self.replay_buffer, None
        assert buffer is not None
        samples: Any
        if self.history_length:
            assert isinstance(buffer, CompactDictReplayBuffer)
            samples, histories = buffer.sample_with_histories(batch_size, self.history_length, env=self.sampling_env)
        else:
            samples = buffer.sample(batch_size, env=self.sampling_env)
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
            histories=histories,
        )

    def refresh_schedules(self) -> None:
        """Before a round of gradient steps: put in tensors what schedules say now."""
        for coefficient in self.coefficients.values():
            coefficient.refresh(self.compile)

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
        Log means over the gradient steps of one ``train()``: the only host transfer.

        :param history: of each gradient step
        :raises DivergenceError: if a metric is not finite
        """
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if not history:
            return
        counts = Counter(name for step in history for name in step)  # a resting network leaves some out
        nothing = th.zeros((), device=self.device)
        sums = th.stack([th.stack([step.get(name, nothing) for name in counts]) for step in history]).sum(dim=0).tolist()
        values = {name: total / count for (name, count), total in zip(counts.items(), sums, strict=True)}
        if (of_deployed := f"{self.policy.roles.deployed}_loss") in values:  # SB3's names for the two
            values["actor_loss"] = values[of_deployed]
        if of_critics := [value for name, value in values.items() if name.endswith("critic_loss")]:
            values["critic_loss"] = sum(of_critics)
        for name, value in values.items():
            self.logger.record(f"train/{name}", value)
        coefficients = {name: coefficient.value for name, coefficient in self.coefficients.items()}
        check_finite_metrics(self, values, self._last_metrics, coefficients)
        self._last_metrics = values


def _joined(metrics: Sequence[Metrics]) -> Metrics:
    return {name: value for part in metrics for name, value in part.items()}


def _layout(value: Any) -> Iterator[Any]:
    """Shapes and types of the tensors in tuples, lists and dicts."""
    if isinstance(value, th.Tensor):
        yield value.shape, value.dtype
    elif isinstance(value, dict):
        for key, part in value.items():
            yield key
            yield from _layout(part)
    elif value is not None:
        for part in value:
            yield from _layout(part)
