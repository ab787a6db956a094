"""A model from its file, with other arguments or environments than it was saved with."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from typing_extensions import Self

from sb3_gac.base.arguments import needed_arguments_from, present_names
from sb3_gac.base.overrides import check_names, check_unchanged, check_whose
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.checks.arguments import KEPT_AS, merged
from sb3_gac.checks.spaces import check_spaces_of


class LoadableAlgorithm(BaseAlgorithm):
    """Loads models; a checkpoint of all that training depends on is :mod:`sb3_gac.base.resuming`'s."""

    restored_arguments: ClassVar[tuple[str, ...]]
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]]
    policy: AsymmetricPolicy
    _change_arguments: Callable[[dict[str, Any]], None]

    @classmethod
    def load(
        cls,
        path: Any,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **given: Any,
    ) -> Self:
        """
        See SB3's ``load``. Without ``env`` there is no replay buffer, until :meth:`set_env` gives one.

        :param path: path of the model's file, or an open file
        :param env: environments to learn on, in any number; ``None`` for a model that only acts
        :param device: device of the networks: "auto", "cpu", "cuda", ...
        :param custom_objects: attribute -> value, in place of values in the file
        :param print_system_info: whether to print versions of the software, now and when the model was saved
        :param force_reset: whether the next ``learn`` starts new episodes
        :param given: arguments of the constructor in place of those that the model was saved with, and
            ``strict_deployment``
        :return: loaded model
        :raises TypeError: naming what is no argument
        :raises ValueError: naming the observation entries whose spaces have changed since the model was saved, arguments
            that can't be changed, or the algorithm if the file holds another one's model
        """
        given = present_names(cls, given, "load()")
        custom_objects = dict(custom_objects or {})
        later = {name: custom_objects.pop(name) for name in cls.restored_arguments if name in custom_objects}
        saved, _, _ = load_from_zip_file(path, device="cpu", custom_objects=custom_objects)
        assert saved is not None
        check_whose(cls, saved, path)
        check_names(cls, given, "load()")
        later |= {name: given.pop(name) for name in cls.restored_arguments if name in given}
        if "policy" in given:
            policy = given.pop("policy")
            check_unchanged("policy", cls.policy_aliases.get(policy, policy), saved["policy_class"], "load()")
        if "policy_kwargs" in given:
            check_unchanged("policy_kwargs", given.pop("policy_kwargs"), saved["policy_kwargs"], "load()")
        if env is not None:
            env = cls._wrap_env(env, saved.get("verbose", 0))
            check_spaces_of(SimpleNamespace(**saved), env, "environment")
            force_reset = force_reset or env.num_envs != saved["n_envs"]
        former = {name: saved.pop(name) for name in merged(cls, "renamed_arguments") if name in saved}
        present = {name: value for name, value in present_names(cls, former, None).items() if name not in saved}
        attributes = {KEPT_AS.get(name, name): value for name, value in (present | given).items()}
        with networks_named(path, [*given, *custom_objects]), needed_arguments_from(saved | attributes, cls):
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **attributes)
        for name in former:
            del vars(model)[name]
        model.policy.freeze_as_saved()
        model._change_arguments(later)
        return model


@contextmanager
def networks_named(path: Any, given: list[str]) -> Iterator[None]:
    """
    Explain an error about networks that do not fit by the arguments that may be the reason.

    :param path: path of the file that the networks come from
    :param given: names of the arguments that replace those in the file
    :raises ValueError: in place of the error, with the explanation
    """
    try:
        yield
    except RuntimeError as error:
        if "loading state_dict" not in str(error):
            raise
        raise ValueError(
            f"The networks in {path} do not fit those that the arguments make: of the arguments {given}, leave out each that "
            f"changes a network. {error}"
        ) from error
