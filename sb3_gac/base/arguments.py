"""Constructor arguments, each written once: tables of shared ones, and signatures that add a class's own."""

import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from inspect import Parameter
from os import PathLike
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, TypedDict, get_args, get_type_hints

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import Schedule

from sb3_gac.base.behaviour import BehaviourSpec
from sb3_gac.base.roles import RoleKeys
from sb3_gac.checks.arguments import merged


class CommonArguments(TypedDict, total=False):
    """Type and default of the keyword-only arguments that on- and off-policy algorithms share."""

    lr_scales: Annotated[Mapping[str, float] | None, None]
    role_keys: Annotated[RoleKeys | None, None]
    compile: Annotated[bool | str, False]
    mixed_precision: Annotated[bool, False]
    stats_window_size: Annotated[int, 100]
    tensorboard_log: Annotated[str | None, None]
    policy_kwargs: Annotated[dict[str, Any] | None, None]
    verbose: Annotated[int, 0]
    seed: Annotated[int | None, None]
    device: Annotated[th.device | str, "auto"]
    _init_setup_model: Annotated[bool, True]


class PositionalArguments(TypedDict, total=False):
    """Type and default of the arguments of SB3's SAC after ``policy`` and ``env``, in SB3's order."""

    learning_rate: Annotated[float | Schedule, 3e-4]
    buffer_size: Annotated[int, 1_000_000]
    learning_starts: Annotated[int, 100]
    batch_size: Annotated[int, 256]
    tau: Annotated[float, 0.005]
    gamma: Annotated[float, 0.99]
    train_freq: Annotated[int | tuple[int, str], 1]
    gradient_steps: Annotated[int, 1]
    action_noise: Annotated[ActionNoise | None, None]
    replay_buffer_class: Annotated[type[ReplayBuffer] | None, None]
    replay_buffer_kwargs: Annotated[dict[str, Any] | None, None]
    optimize_memory_usage: Annotated[bool, False]
    n_steps: Annotated[int, 1]
    ent_coef: Annotated[str | float, "auto"]
    target_update_interval: Annotated[int, 1]
    target_entropy: Annotated[str | float, "auto"]


class _OffPolicyArguments(PositionalArguments, total=False):
    max_grad_norm: Annotated[float | None, 1.0]
    policy_delay: Annotated[int, 1]
    update_every: Annotated[Mapping[str, int] | None, None]
    behaviour: Annotated[BehaviourSpec, None]
    behaviour_per: Annotated[str, "episode"]
    recording: Annotated[str | PathLike | None, None]
    random_shift: Annotated[int, 0]


class OffPolicyArguments(_OffPolicyArguments, CommonArguments, total=False):
    """
    All arguments that off-policy algorithms share, see ``AsymmetricOffPolicyAlgorithm``, except ``policy`` and ``env``.

    A subclass with arguments of its own names only these, keyword-only, and hands on all others::

        def __init__(self, policy, env, *sb3, teacher, coef_step=0.01, **shared: Unpack[OffPolicyArguments]):
            self.teacher, self.coef_step = teacher, coef_step
            super().__init__(policy, env, *sb3, **shared)
    """


class PositionalOnPolicyArguments(TypedDict, total=False):
    """Type and default of the arguments of SB3's PPO after ``policy`` and ``env`` that all on-policy algorithms have."""

    learning_rate: Annotated[float | Schedule, 3e-4]
    n_steps: Annotated[int, 2048]
    batch_size: Annotated[int, 64]
    n_epochs: Annotated[int, 10]
    gamma: Annotated[float, 0.99]
    gae_lambda: Annotated[float, 0.95]
    clip_range: Annotated[float | Schedule, 0.3]
    normalize_advantage: Annotated[bool, True]
    ent_coef: Annotated[float, 0.0]
    vf_coef: Annotated[float, 0.25]


class _OnPolicyArguments(PositionalOnPolicyArguments, total=False):
    max_grad_norm: Annotated[float | None, 1.0]
    reward_scale: Annotated[float, 1.0]
    unroll_length: Annotated[int | None, None]


class OnPolicyArguments(_OnPolicyArguments, CommonArguments, total=False):
    """All arguments that on-policy algorithms share, see ``AsymmetricOnPolicyAlgorithm``, except ``policy`` and ``env``."""


def _signature(shared: type, positional: type) -> inspect.Signature:
    by_position = positional.__annotations__
    parameters = []
    for name, hint in get_type_hints(shared, include_extras=True).items():
        kind = Parameter.POSITIONAL_OR_KEYWORD if name in by_position else Parameter.KEYWORD_ONLY
        annotation, default = get_args(hint)
        parameters.append(Parameter(name, kind, default=default, annotation=annotation))
    return inspect.Signature(parameters)


#: Table of shared arguments -> signature
SHARED: dict[type, inspect.Signature] = {
    OffPolicyArguments: _signature(OffPolicyArguments, PositionalArguments),
    OnPolicyArguments: _signature(OnPolicyArguments, PositionalOnPolicyArguments),
}


def with_defaults(shared: type, by_position: Sequence[Any], by_name: Mapping[str, Any]) -> dict[str, Any]:
    """
    Complete arguments by their defaults.

    :param shared: table of arguments, a key of ``SHARED``
    :param by_position: values of the first arguments of the table, in its order
    :param by_name: name -> value of others
    :return: name -> value, for every argument of the table
    :raises TypeError: if there are too many arguments, or one is given twice
    """
    bound = SHARED[shared].bind(*by_position, **by_name)
    bound.apply_defaults()
    return bound.arguments


class ConstructorArguments:
    """
    Base of classes whose constructors take some arguments and hand on the others.

    A constructor's signature shows the arguments that it hands on as well. Former names of arguments work like the present
    ones, with a warning. Each argument is kept as the attribute of its name, so that files hold it.
    """

    #: Former name -> present name of arguments, for one release; entries of ancestors count as well
    renamed_arguments: ClassVar[Mapping[str, str]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        has_constructor = any("__init__" in vars(kind) for kind in cls.__mro__ if _is_ours(kind))
        if has_constructor and not hasattr(cls.__init__, "__signature__"):  # the class's own constructor, or a mixin's
            type.__setattr__(cls, "__init__", _prepared(cls.__init__, inspect.Signature(_constructor_parameters(cls.__mro__))))
        for former, present in merged(cls, "renamed_arguments").items():
            setattr(cls, former, _former_attribute(former, present))


def _is_ours(kind: type) -> bool:
    return issubclass(kind, ConstructorArguments)


def _constructor_parameters(mro: Sequence[type]) -> list[Parameter]:
    """
    :param mro: a class and its ancestors, in the order of method resolution
    :return: parameters that the first constructor names, and those that it hands on to the next one
    """
    kind, *others = [kind for kind in mro if "__init__" in vars(kind)]
    own = list(inspect.signature(inspect.unwrap(vars(kind)["__init__"])).parameters.values())
    positional = [each for each in own if each.kind <= Parameter.POSITIONAL_OR_KEYWORD]
    by_name = [each for each in own if each.kind is Parameter.KEYWORD_ONLY]
    variable = {each.kind: each.annotation for each in own if each not in [*positional, *by_name]}
    if Parameter.VAR_KEYWORD not in variable or not others:
        return [*positional, *by_name]
    handed_on = _constructor_parameters(others)
    (shared,) = get_args(variable[Parameter.VAR_KEYWORD]) or (None,)
    if shared in SHARED and not any("__init__" in vars(other) for other in others if _is_ours(other)):
        handed_on = list(SHARED[shared].parameters.values())
    named_before, named_behind = ({each.name for each in group} for group in (positional, by_name))
    by_position = Parameter.VAR_POSITIONAL in variable
    for each in handed_on:
        if each.name in named_before:
            continue
        # An argument that the class names itself can't come by position, nor can those that follow it
        by_position &= each.name not in named_behind and each.kind <= Parameter.POSITIONAL_OR_KEYWORD
        by_position &= each.default is not Parameter.empty or all(one.default is Parameter.empty for one in positional)
        if by_position:
            positional.append(each)
        elif each.name not in named_behind:
            by_name.append(each.replace(kind=Parameter.KEYWORD_ONLY))
    return [*positional, *by_name]


def _prepared(init: Callable[..., None], signature: inspect.Signature) -> Callable[..., None]:
    """
    :param init: a class's constructor
    :param signature: signature of the constructor, arguments that it hands on included
    :return: the constructor with that signature, called with the present names of arguments
    """
    named = [each for each in signature.parameters.values() if each.kind is not Parameter.VAR_KEYWORD]
    needed = [each.name for each in named if each.default is Parameter.empty]

    @wraps(init)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        if type(self).__init__ is __init__:  # not where a subclass's constructor calls this one
            kwargs = present_names(type(self), kwargs, f"{type(self).__name__}()")
            saved = _SAVED.get().get(type(self), {})
            kwargs = {name: saved[name] for name in needed if name in saved} | kwargs
        init(self, *args, **kwargs)

    __init__.__signature__ = signature  # type: ignore[attr-defined]
    return __init__


def _former_attribute(former: str, present: str) -> property:
    def warn(model: Any) -> None:
        kind = type(model).__name__
        warnings.warn(f"{kind}.{former} is {kind}.{present} now.", DeprecationWarning, stacklevel=3)

    def read(model: Any) -> Any:
        warn(model)
        return getattr(model, present)

    def write(model: Any, value: Any) -> None:
        warn(model)
        setattr(model, present, value)

    return property(read, write)


def present_names(kind: type, given: Mapping[str, Any], where: str | None) -> dict[str, Any]:
    """
    Replace former names of arguments by present ones.

    :param kind: class whose constructor takes the arguments
    :param given: former or present name -> argument
    :param where: call that the arguments were given to, for the warning about former names; ``None`` for those in a file,
        which cause no warning
    :return: present name -> argument
    :raises TypeError: if an argument is given by both names
    """
    renamed = merged(kind, "renamed_arguments")
    for former in [name for name in given if name in renamed]:
        present = renamed[former]
        if present in given:
            raise TypeError(f'{where or kind.__name__} got "{present}" twice, also by its former name: leave "{former}" out.')
        if where is not None:
            warnings.warn(f'{where} got "{former}", which is "{present}" now.', DeprecationWarning, stacklevel=3)
    return {renamed.get(name, name): value for name, value in given.items()}


#: Class -> attributes in the file that is being loaded
_SAVED: ContextVar[Mapping[type, Mapping[str, Any]]] = ContextVar("saved", default=MappingProxyType({}))


@contextmanager
def needed_arguments_from(saved: Mapping[str, Any], kind: type) -> Iterator[None]:
    """
    Give a constructor its arguments without a default from a file.

    SB3's ``load`` calls the constructor with ``policy``, ``env`` and ``device`` alone, and restores attributes afterwards.

    :param saved: name -> attribute in the file
    :param kind: class of the model that is loaded
    """
    token = _SAVED.set({kind: saved})
    try:
        yield
    finally:
        _SAVED.reset(token)
