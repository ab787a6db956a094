"""What a gradient step is put together from: the one primitive ``minimize``, programs, and what is logged."""

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial, wraps
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.base.batch import Batch, Loss, Metrics, Outputs
from sb3_gac.base.compiling import AUTO
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.divergence import check_finite_metrics
from sb3_gac.math.losses import critic_loss, masked_mean
from sb3_gac.optim.coefficients import Coefficient
from sb3_gac.optim.compile import Program
from sb3_gac.optim.parallel import Worker, worker


class _Step(NamedTuple):
    """
    A step that waits for :meth:`GradientSteps.joined`.

    :param take: what takes it
    :param metrics: filled when it has been taken
    """

    take: Callable[[], Metrics]
    metrics: Metrics


def _scheduled(minimize: Callable[..., Metrics]) -> Callable[..., Metrics]:
    """
    Where there is a worker, steps wait for :meth:`GradientSteps.joined`, and so do their metrics.

    :param minimize: see :meth:`GradientSteps.minimize`
    """

    @wraps(minimize)
    def scheduled(self: Any, networks: str | tuple[str, ...], loss: Callable[..., Loss], *tensors: Any) -> Metrics:
        if self._worker is None:
            return minimize(self, networks, loss, *tensors)
        step = _Step(partial(minimize, self, networks, loss, *tensors), Metrics())
        self._branches[self._runs_beside(networks)].append(step)
        return step.metrics

    return scheduled


class GradientSteps(BaseAlgorithm):
    """
    Gradient steps of a policy's networks and coefficients: an algorithm writes one ``update``, made of ``minimize``.

    What changes from step to step must be a tensor: an argument of a loss, a parameter or a coefficient's value. Numbers that
    a loss finds on ``self`` are named in ``compiled_settings``. The attributes below are those of
    :class:`sb3_gac.base.algorithm.AsymmetricAlgorithm`.
    """

    #: Arguments that a compiled update takes for constants: a change compiles it anew
    compiled_settings: ClassVar[tuple[str, ...]] = ("max_grad_norm", "mixed_precision")
    policy: AsymmetricPolicy
    coefficients: dict[str, Coefficient]
    max_grad_norm: float | None
    mixed_precision: bool
    programs: dict[Any, Program]
    #: What :class:`sb3_gac.base.compiling.Compilation` has decided
    compile: bool | str
    compiles: bool
    _compiles_on_auto: bool
    _failed_to_compile: bool
    _compiling_failed: Callable[[Exception], None]
    _branches_are_independent: bool
    #: Takes the steps of :attr:`AsymmetricPolicy.side_branch`, in a round in which branches run at once
    _worker: Worker | None = None
    #: Whether beside -> steps that wait for :meth:`joined`, during such a round
    _branches: dict[bool, list[_Step]]
    _program_key: tuple[Any, ...] = ()
    #: Networks that the gradient step under way leaves as they are, see ``update_every``
    _resting: frozenset[str] = frozenset()
    #: Of the last round of gradient steps, all finite
    _last_metrics: Mapping[str, float] = MappingProxyType({})

    # --- what an algorithm writes, and what it writes it with ---------------------------------------------------------

    @_scheduled
    def minimize(self, networks: str | tuple[str, ...], loss: Callable[..., Loss], *tensors: Any) -> Metrics:
        """
        One step of a network's optimiser down a loss, for which all other networks are constants.

        :param networks: name of one, or of several that share a loss, each with its own optimiser; the gradient by all of
            them is scaled to a norm of at most ``max_grad_norm``
        :param loss: function of the tensors
        :param tensors: in tuples or dicts; what changes from step to step
        :return: the loss under the (first) network's name, the norms of the gradients, and the loss's metrics; nothing of a
            network that an ablation does without
        """
        names = (networks,) if isinstance(networks, str) else networks
        if not self.policy.has(names[0]):
            return {}
        with self._precision():
            value, metrics = loss(*tensors)
        metrics = {name: metric.detach() for name, metric in {f"{names[0]}_loss": value, **metrics}.items()}
        trained = {name: self.policy.trained[name] for name in names if name not in self._resting}
        parameters = [parameter for network in trained.values() for parameter in network.parameters]
        gradients: Sequence[th.Tensor] = ()
        if parameters and value.requires_grad:
            gradients = th.autograd.grad(value, parameters, allow_unused=True, materialize_grads=True)
        own = dict(zip(trained, _split(gradients, [len(network.parameters) for network in trained.values()]), strict=True))
        norms = {name: network.norm(own[name]) for name, network in trained.items()}
        scale = scale_of(list(norms.values()), self.max_grad_norm)
        for name, network in trained.items():
            network.step(own[name], scale)
        return metrics | {f"{name}_grad_norm": norm for name, norm in norms.items()}

    def joined(self, *steps: Metrics) -> Metrics:
        """
        Where there is a worker, it takes the steps of the side branch while this thread takes the others.

        :param steps: what :meth:`minimize` has returned
        :return: all of it, when all is done
        """
        if self._worker is not None:
            beside, here = self._branches[True], self._branches[False]
            self._branches = {True: [], False: []}
            self._worker.submit(partial(_take, beside))
            _take(here)
            self._worker.wait()
        return {name: value for step in steps for name, value in step.items()}

    def outputs(self, batch: Batch, *roles: str) -> list[Outputs]:
        """
        Forward passes of policies, before any network is changed.

        :param batch: of transitions
        :param roles: names of the policies
        """
        found: dict[str, Outputs] = {}

        def run(role: str) -> None:
            with self._precision():
                found[role] = batch.outputs(getattr(self.policy, role))

        for role in roles:
            self._worker.submit(partial(run, role)) if self._runs_beside(role) else run(role)  # type: ignore[union-attr]
        if self._worker is not None:
            self._worker.wait()
        return [found[role] for role in roles]

    def _runs_beside(self, networks: str | tuple[str, ...]) -> bool:
        return self._worker is not None and networks in self.policy.side_branch

    def bellman_loss(self, name: str, batch: Batch, target: th.Tensor) -> Loss:
        r"""
        :param name: of the critics
        :param batch: of transitions
        :param target: Bellman target, shape (\*E)
        :return: squared Bellman residual, with the mean Q
        """
        q = getattr(self.policy, name)(batch.observations, batch.actions)
        loss = critic_loss(q, target, batch.mask, batch.critic_weights)
        return Loss(loss, {f"{name}_q": masked_mean(q.detach().mean(dim=0), batch.mask)})

    def coefficient_values(self) -> Metrics:
        """To be logged: name -> value, the mean over dimensions where there are several."""
        return {name: coefficient.value.mean() for name, coefficient in self.coefficients.items()}

    # --- a round of steps ---------------------------------------------------------------------------------------------

    @contextmanager
    def gradient_steps_under_way(self) -> Iterator[list[Metrics]]:
        """
        A round of gradient steps: networks in training mode, learning rates and schedules as they are by now.

        :return: list for the metrics of each step, whose means are logged at the end
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self._scheduled_optimizers())
        self._compiles_on_auto &= not self._failed_to_compile
        self.policy.refresh_parameters(self.compiles)
        self.refresh_schedules()
        settings = (getattr(self, name) for name in self.compiled_settings)
        self._program_key = (self.policy, self.policy.optimizer_options, th.get_num_threads(), *settings)
        history: list[Metrics] = []
        self._branches = {True: [], False: []}
        try:
            in_branches = self._branches_are_independent and not self.compiles and th.get_num_threads() > 1
            with worker(in_branches) as self._worker:
                yield history
        finally:
            self._worker = None
            del self._branches
        self._record_metrics(history)

    def _compiled(self, name: Any, function: Callable[..., Any], *args: Any) -> Any:
        """
        :param name: of the function
        :param function: of tensors, and of what the key says of this object
        :param args: its arguments
        :return: its value, by a program of its own for all that the key says
        """
        key = (name, self._resting, *self._program_key, *_layout(args))
        if key not in self.programs:
            when_it_fails = self._compiling_failed if self.compile == AUTO else None
            self.programs[key] = Program(function, self.device, when_it_fails)
        return self.programs[key](*args)

    def _precision(self) -> AbstractContextManager:
        if self.mixed_precision:
            return th.autocast(self.device.type, th.bfloat16, cache_enabled=False)
        return nullcontext()

    def refresh_schedules(self) -> None:
        """Before a round of gradient steps: put in tensors what schedules say now."""
        for coefficient in self.coefficients.values():
            coefficient.refresh(self.compiles)

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


def _take(steps: Sequence[_Step]) -> None:
    """One after the other."""
    for step in steps:
        step.metrics.update(step.take())


def _split(gradients: Sequence[th.Tensor], counts: Sequence[int]) -> Iterator[Sequence[th.Tensor]]:
    for count in counts:
        yield gradients[:count]
        gradients = gradients[count:]


def scale_of(norms: Sequence[th.Tensor], max_norm: float | None) -> th.Tensor | None:
    """
    :param norms: of parts of a gradient
    :param max_norm: what the norm of all is to be at most; ``None`` for no bound
    :return: what the gradient is to be multiplied with, as torch's ``clip_grad_norm_`` has it
    """
    if max_norm is None or not norms:
        return None
    norm = norms[0] if len(norms) == 1 else th.linalg.vector_norm(th.stack(list(norms)))
    return (max_norm / (norm + 1e-6)).clamp(max=1.0)


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
