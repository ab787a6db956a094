"""Arguments that are set on a model after it was made: they take effect, or are refused by name."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, ClassVar

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.checks.arguments import KEPT_AS, constructor_arguments, make_arguments_plain
from sb3_gac.optim.coefficients import Coefficient, LearnedCoefficient
from sb3_gac.optim.compile import Programs


class ChangingArguments(BaseAlgorithm):
    """
    Follows arguments that change: set by a callback, or given to ``load`` or ``resume``.

    A training that goes by a value from its first step on, and one whose value is set before its first step, are the same.
    """

    #: Arguments that networks and data are built of, beside those of the policy class; they can't change
    built_in_arguments: ClassVar[tuple[str, ...]] = ()
    coefficients: dict[str, Coefficient]
    programs: Programs
    make_coefficients: Callable[[], dict[str, Coefficient]]
    _all_policy_kwargs: Callable[[], dict[str, Any]]
    _check_arguments: Callable[[], None]
    _check_coefficients: Callable[[], None]
    _keep_coefficients: Callable[[], None]
    #: Name -> value of all arguments that training goes by
    _in_force: dict[str, Any]

    def follow_arguments(self) -> None:
        """
        Have arguments that were set on the model take effect, before a rollout and before a round of gradient steps.

        :raises ValueError: naming an argument that has a wrong value, or that networks or data are built of; all arguments are
            then what they were before
        """
        now = arguments_of(self)
        changed = {name: value for name, value in now.items() if differ(value, self._in_force.get(name))}
        if changed:
            set_arguments(self, {name: copied(self._in_force.get(name)) for name in changed})
            self._change_arguments(changed, "Setting an argument")

    def keep_in_force(self) -> None:
        """Take note of the arguments that training goes by, and of what is in their dicts and lists."""
        self._in_force = {name: copied(value) for name, value in arguments_of(self).items()}

    def save(self, path: Any, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """
        See SB3's ``save``; arguments that were set on the model take effect before.

        :param path: path of the model's file, or an open file
        :param exclude: names of attributes that are left out, besides those that always are
        :param include: names of attributes that are saved although they would be left out
        :raises ValueError: naming an argument that can't take effect, see :meth:`follow_arguments`
        """
        self.follow_arguments()  # a file must not hold a value that no model can be made with
        super().save(path, exclude, include)

    def _change_arguments(self, given: dict[str, Any], of: str = "load()") -> None:
        """
        Change arguments of a model that is made already.

        A coefficient that is learned before and after goes on from its value, unless it is given a start value.

        :param given: name -> value
        :param of: what changes the arguments, for the message
        :raises ValueError: naming the argument; the model is then as it was before
        """
        if not given:
            return
        before, attributes, built_of = arguments_of(self), dict(vars(self)), self._built_of()
        try:
            set_arguments(self, given)
            make_arguments_plain(self)
            self._check_arguments()
            self._check_coefficients()
            check_not_built_in(given, built_of, self._built_of(), of)
            self._remake_coefficients(set(given), before)
            self.take_effect(set(given))
        except Exception:
            vars(self).update(attributes)
            raise
        self.keep_in_force()

    def _built_of(self) -> dict[str, Any]:
        """Name -> value of all that networks and data are built of."""
        fixed = {name: getattr(self, KEPT_AS.get(name, name)) for name in self.built_in_arguments if name != "policy_kwargs"}
        return {**fixed, "policy_kwargs": self._all_policy_kwargs() | {"lr_scales": None}}

    def _remake_coefficients(self, changed: set[str], before: dict[str, Any]) -> None:
        """
        Make those coefficients anew whose arguments, which begin with their names, have changed.

        :param changed: names of the changed arguments
        :param before: name -> value of all arguments before
        """
        remade = [name for name in self.coefficients if any(argument.startswith(name) for argument in changed)]
        if not remade:
            return
        fresh = self.make_coefficients()
        for name in remade:
            coefficient, spec = self.coefficients[name], getattr(self, name, None)
            if spec == before.get(name) or (spec == "auto" and isinstance(coefficient, LearnedCoefficient)):
                fresh[name].go_on_from(coefficient)
        self.coefficients = {name: fresh[name] if name in remade else kept for name, kept in self.coefficients.items()}
        self._keep_coefficients()
        self.programs.clear()  # programs hold the former ones

    @abstractmethod
    def take_effect(self, changed: set[str]) -> None:
        """
        Make anew what was made of arguments; whatever reads an argument at each use needs nothing.

        What may fail comes first, and new objects take the place of former ones: after an error all attributes are put back.

        :param changed: names of the arguments that have changed
        """

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_in_force"]


@cache
def _attributes(algorithm: type) -> dict[str, str]:
    """Name of each constructor argument -> attribute that keeps it."""
    return {name: KEPT_AS.get(name, name) for name in constructor_arguments(algorithm)}


def arguments_of(model: Any) -> dict[str, Any]:
    """
    The arguments of a model as they are now.

    :param model: model
    :return: name -> value
    """
    attributes = _attributes(type(model))  # type: ignore[arg-type]
    return {name: getattr(model, attribute) for name, attribute in attributes.items() if hasattr(model, attribute)}


def set_arguments(model: Any, arguments: Mapping[str, Any]) -> None:
    """
    Set attributes that keep arguments.

    :param model: model
    :param arguments: name -> value
    """
    vars(model).update({KEPT_AS.get(name, name): value for name, value in arguments.items()})


def copied(value: Any) -> Any:
    """
    Copy the containers of an argument, so that a change in place can be told.

    :param value: value of the argument
    :return: dicts, lists, tuples and sets with the same contents; anything else is returned itself
    """
    if isinstance(value, Mapping):
        return {key: copied(entry) for key, entry in value.items()}
    return type(value)(map(copied, value)) if type(value) in (list, tuple, set) else value


def differ(value: Any, before: Any) -> bool:
    """
    Whether an argument has changed.

    :param value: value of the argument
    :param before: value that it had before
    :return: whether the two differ; two objects of a class that can't be compared do
    """
    if value is before:
        return False
    value, before = copied(value), copied(before)
    try:
        return not (type(value) is type(before) and bool(value == before))
    except (TypeError, ValueError):  # dicts and lists that hold arrays
        return True


def check_not_built_in(given: Mapping[str, Any], before: Mapping[str, Any], now: Mapping[str, Any], of: str) -> None:
    """
    Check that networks and data would be built as they are.

    :param given: name -> value of the arguments that have changed
    :param before: name -> value of what networks and data were built of
    :param now: name -> value of what they would be built of with the given arguments
    :param of: what changes the arguments, for the message
    :raises ValueError: naming the arguments
    """
    if any(differ(now[name], before[name]) for name in before):
        raise ValueError(
            f"{of} can't change {', '.join(given)}: the model's networks, data or random numbers were made with what it was. "
            "Make a new model; copy_networks() takes over the networks that both have."
        )
