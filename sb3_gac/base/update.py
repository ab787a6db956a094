"""The parts of a gradient step: the primitive ``minimize``, compiled programs, and the logging of metrics."""

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.base.batch import Batch, Loss, Metrics, Outputs
from sb3_gac.base.compiling import AUTO
from sb3_gac.base.frozen import FrozenPolicy
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.divergence import check_finite_metrics
from sb3_gac.math.losses import critic_loss, masked_mean
from sb3_gac.optim.coefficients import Coefficient
from sb3_gac.optim.compile import Programs
from sb3_gac.optim.parallel import Worker, worker


class GradientSteps(BaseAlgorithm):
    """
    Gradient steps of a policy's networks and coefficients: an algorithm writes one ``update``, made of ``minimize``.

    Whatever changes from step to step must be a tensor: an argument of a loss, a parameter or a coefficient's value. Numbers
    that a loss finds on ``self`` are named in ``compiled_settings``. The attributes below are those of
    :class:`sb3_gac.base.algorithm.AsymmetricAlgorithm`.
    """

    #: Arguments that are constants of a compiled update, which is compiled anew when one of them changes
    compiled_settings: ClassVar[tuple[str, ...]] = ("max_grad_norm", "mixed_precision")
    policy: AsymmetricPolicy
    frozen: dict[str, FrozenPolicy]
    coefficients: dict[str, Coefficient]
    max_grad_norm: float | None
    mixed_precision: bool
    programs: Programs
    #: The argument ``compile``, and what :class:`sb3_gac.base.compiling.Compilation` has decided
    compile: bool | str
    compiles: bool
    _compiles_on_auto: bool
    _failed_to_compile: bool
    _compiling_failed: Callable[[Exception], None]
    _branches_are_independent: bool
    #: Thread that takes the steps of :attr:`AsymmetricPolicy.side_branch`, in a round in which branches run at once
    _worker: Worker | None = None
    #: Networks that the gradient step under way leaves as they are, see ``update_every``
    _resting: frozenset[str] = frozenset()
    #: Metrics of the last round of gradient steps, all finite
    _last_metrics: Mapping[str, float] = MappingProxyType({})

    # --- what an algorithm's update is made of ------------------------------------------------------------------------

    def minimize(self, networks: str | tuple[str, ...], loss: Callable[..., Loss], *tensors: Any) -> Metrics:
        """
        One step of a network's optimiser down a loss, for which all other networks are constants.

        :param networks: name of a network, or names of several that share a loss, each with its own optimiser; the gradient
            with respect to all of them is scaled to a norm of at most ``max_grad_norm``. While the first one rests, all do
        :param loss: function of ``tensors`` that returns the loss and its metrics
        :param tensors: arguments of the loss, also in tuples or dicts: all that changes from step to step
        :return: name -> metric: the loss under the (first) network's name, the norm of each network's gradient, and the
            loss's metrics; empty for a network that an ablation does without
        """
        names = (networks,) if isinstance(networks, str) else networks
        if not self.policy.has(names[0]):
            return {}
        with self._precision():
            value, metrics = loss(*tensors)
        metrics = {f"{names[0]}_loss": value, **metrics}
        metrics = {name: metric.detach() if metric.requires_grad else metric for name, metric in metrics.items()}
        takes_steps = [] if names[0] in self._resting else [name for name in names if name not in self._resting]
        trained = {name: self.policy.trained[name] for name in takes_steps}
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

    def in_branches(self, beside: Callable[[], Metrics], here: Callable[[], Metrics]) -> Metrics:
        """
        Take two chains of steps that share nothing but constants: at the same time if there is a worker, else in their order.

        :param beside: function that minimizes the losses of :attr:`AsymmetricPolicy.side_branch`, which a worker runs
        :param here: function that minimizes the other losses
        :return: metrics of both chains
        """
        if self._worker is None:
            return beside() | here()
        metrics = Metrics()
        self._worker.submit(lambda: metrics.update(beside()))
        own = here()
        self._worker.wait()
        return metrics | own

    def outputs(self, batch: Batch, *roles: str) -> list[Outputs]:
        """
        Forward passes of policies, before any network is changed.

        :param batch: batch of transitions
        :param roles: names of the policies
        :return: outputs of the policies' networks for the batch, in the order of ``roles``
        """
        found: dict[str, Outputs] = {}

        def run(role: str) -> None:
            with self._precision():
                found[role] = batch.outputs(getattr(self.policy, role))

        for role in roles:
            if self._worker is not None and role in self.policy.side_branch:
                self._worker.submit(partial(run, role))
            else:
                run(role)
        if self._worker is not None:
            self._worker.wait()
        return [found[role] for role in roles]

    def bellman_loss(self, name: str, batch: Batch, target: th.Tensor) -> Loss:
        r"""
        The loss of critics.

        :param name: name of the critics' network
        :param batch: batch of transitions
        :param target: Bellman target, shape (\*E)
        :return: squared Bellman residual, with the mean Q as its metric
        """
        q = getattr(self.policy, name)(batch.observations, batch.actions)
        loss = critic_loss(q, target, batch.mask, batch.critic_weights)
        return Loss(loss, {f"{name}_q": masked_mean(q.detach().mean(dim=0), batch.mask)})

    def coefficient_values(self) -> Metrics:
        """Metrics of the coefficients: name -> value, its mean if there is one for each action dimension."""
        return {name: coefficient.value.mean() for name, coefficient in self.coefficients.items()}

    # --- a round of steps ---------------------------------------------------------------------------------------------

    @contextmanager
    def gradient_steps_under_way(self) -> Iterator[list[Metrics]]:
        """
        The context of a round of gradient steps: networks in training mode, present learning rates and schedules.

        :return: context, whose value is a list for the metrics of each step; their means are logged at the end
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self._scheduled_optimizers())
        self._compiles_on_auto &= not self._failed_to_compile
        self.policy.refresh_parameters(self.compiles)
        self.refresh_schedules()
        settings = (getattr(self, name) for name in self.compiled_settings)
        constants = (self.policy, *self.frozen.values(), self.policy.optimizer_options, th.get_num_threads())
        self.programs.settings = (*constants, *settings)
        history: list[Metrics] = []
        try:
            in_branches = self._branches_are_independent and not self.compiles and th.get_num_threads() > 1
            with worker(in_branches) as self._worker:
                yield history
        finally:
            self._worker = None
        self._record_metrics(history)

    def compiled(self, step: Callable[..., Metrics], batch: Any) -> Metrics:
        """
        Call a gradient step by its compiled program.

        :param step: function of tensors, which may also depend on the policy and on :attr:`compiled_settings`
        :param batch: batch of transitions
        :return: metrics of the step
        """
        when_it_fails = self._compiling_failed if self.compile == AUTO else None
        return self.programs.run(step, batch, variant=self._resting, device=self.device, when_it_fails=when_it_fails)

    def _precision(self) -> AbstractContextManager:
        if self.mixed_precision:
            return th.autocast(self.device.type, th.bfloat16, cache_enabled=False)
        return nullcontext()

    def refresh_schedules(self) -> None:
        """Put the present values of schedules into tensors, before a round of gradient steps."""
        for coefficient in self.coefficients.values():
            coefficient.refresh(self.compiles)

    @abstractmethod
    def _scheduled_optimizers(self) -> list[th.optim.Optimizer]:
        """Optimisers that follow ``learning_rate``."""

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        """
        Set learning rates to the schedule's present value, times the "lr_scale" of a parameter group.

        :param optimizers: optimisers whose learning rates are set
        """
        super()._update_learning_rate(optimizers)
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            for group in optimizer.param_groups:
                group["lr"] *= group.get("lr_scale", 1.0)

    def _record_metrics(self, history: list[Metrics]) -> None:
        """
        Log means over the gradient steps of one ``train()``, which takes the only transfer from the device to the host.

        :param history: metrics of each gradient step
        :raises DivergenceError: if a metric is not finite
        """
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if not history:
            return
        counts = Counter(name for step in history for name in step)  # a resting network leaves some out
        nothing = th.zeros((), device=self.device)
        sums = th.stack([th.stack([step.get(name, nothing) for name in counts]) for step in history]).sum(dim=0).tolist()
        values = {name: total / count for (name, count), total in zip(counts.items(), sums, strict=True)}
        if (of_deployed := f"{self.policy.roles.deployed}_loss") in values:  # under SB3's names as well
            values["actor_loss"] = values[of_deployed]
        if of_critics := [value for name, value in values.items() if name.endswith("critic_loss")]:
            values["critic_loss"] = sum(of_critics)
        for name, value in values.items():
            self.logger.record(f"train/{name}", value)
        coefficients = {name: coefficient.value for name, coefficient in self.coefficients.items()}
        check_finite_metrics(self, values, self._last_metrics, coefficients)
        self._last_metrics = values


def _split(gradients: Sequence[th.Tensor], counts: Sequence[int]) -> Iterator[Sequence[th.Tensor]]:
    for count in counts:
        yield gradients[:count]
        gradients = gradients[count:]


def scale_of(norms: Sequence[th.Tensor], max_norm: float | None) -> th.Tensor | None:
    """
    The factor that clips a gradient.

    :param norms: norms of the parts of the gradient, scalars
    :param max_norm: bound on the norm of the whole gradient; ``None`` for no bound
    :return: factor for the gradient, as in torch's ``clip_grad_norm_``; ``None`` where the gradient stays as it is
    """
    if max_norm is None or not norms:
        return None
    norm = norms[0] if len(norms) == 1 else th.linalg.vector_norm(th.stack(list(norms)))
    if _is_on_host(norm) and not th.compiler.is_compiling() and float(norm) + 1e-6 <= max_norm:
        return None
    return (max_norm / (norm + 1e-6)).clamp(max=1.0)


def _is_on_host(tensor: th.Tensor) -> bool:
    """
    :return: whether a comparison of the tensor needs no transfer. There it saves a pass over all gradients, where none is
        clipped
    """
    return tensor.device.type == "cpu"
