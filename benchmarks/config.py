"""
The arguments of a run's algorithm: layers of YAML, later ones over earlier ones, checked against the algorithm's signature.

The layers are, in their order: the preset's arguments, its arguments for the task, those for the task at that noise (each
first for ``all`` algorithms, then for the families and classes from which the algorithm descends), the suite's overrides,
and the algorithm's own arguments.
"""

import json
import traceback
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from hashlib import sha256
from typing import Any

from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.environments import environment, make_envs
from benchmarks.external import Program
from benchmarks.suite import RunSpec, needed_runs, read_definitions, with_needed
from benchmarks.yaml_checks import check_is, check_keys, check_numbers
from sb3_gac.algorithms import algorithm_class
from sb3_gac.base.arguments import present_names
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.envs.spaces import PARTIAL
from sb3_gac.envs.suites import SUITES, is_batched, suite_of
from sb3_gac.presets import instantiate, merge, read_preset
from sb3_gac.presets.noises import defaults_of
from sb3_gac.training.environments import normalized

POLICY = "MultiInputPolicy"
#: Arguments that a run sets itself, so that another value would be recorded and have no effect -> what to do instead
_GIVEN_TO_RUNS = {"seed": "list seeds in the cell", "device": "all runs are made on the CPU"}
_GIVEN_TO_POLICIES = {"observation_space", "action_space", "lr_schedule"}


def read_algorithm(name: str, definition: Mapping[str, Any] | None = None) -> tuple[type, dict[str, Any]]:
    """
    :param name: name of an algorithm
    :param definition: definition of the algorithm, ``None`` for the one in ``hyperparams/algorithms.yml``
    :return: class of the algorithm, and the arguments of its definition
    :raises ValueError: if there is no such algorithm or class
    """
    if definition is None:
        definitions = read_definitions()
        if name not in definitions:
            raise ValueError(f"algorithm must be one of {sorted(definitions)}, got {name!r}.")
        definition = definitions[name]
    check_keys(f"algorithm {name}", definition, {"class", *definition}, {"class"})
    try:
        kind = algorithm_class(str(definition["class"]))
    except ValueError as error:
        raise ValueError(f"algorithm {name}, class: {error}") from None
    return kind, {key: value for key, value in definition.items() if key not in ("class", "needs", "normalize")}


def normalization(spec: RunSpec) -> dict[str, Any] | None:
    """
    :param spec: settings of a run
    :return: keyword arguments of the ``VecNormalize`` around its environments: ``normalize`` of the algorithm's definition, or
        those that the preset has for the algorithm; ``None`` if nothing is normalised
    :raises ValueError: if ``normalize`` is no mapping
    """
    definition = read_definitions()[spec.algorithm] if spec.definition is None else spec.definition
    kind, _ = read_algorithm(spec.algorithm, spec.definition)
    given = definition.get("normalize", read_preset(spec.preset).normalization(kind))
    if given is not None:
        check_is(f"algorithm {spec.algorithm}, normalize", given, "a mapping, such as {clip_obs: 5.0}", Mapping)
    return given


def check_runs(where: str, specs: Iterable[RunSpec]) -> None:
    """
    Check before the first run that the runs can be made, as far as this can be told without training. Each algorithm is made
    once with its arguments, and environments that are no registered tasks are tried out.

    :param where: name of the suite, with which an error message begins
    :param specs: settings of the suite's runs
    :raises ValueError: naming an algorithm, a task or an argument that does not exist, or a number that YAML reads as text, or
        with the error that an algorithm raises about an argument or an environment
    """
    kinds = {(spec.algorithm, spec.cell): spec for spec in with_needed(specs)}
    for spec in kinds.values():
        try:
            environment(spec)
            resolve(spec)
            normalization(spec)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    _check_values(where, kinds.values())
    for spec in kinds.values():
        if spec.environment is not None:
            try_out(where, spec)


def _check_values(where: str, specs: Iterable[RunSpec]) -> None:
    """Make one algorithm for each class and set of arguments, on one of the registered tasks that it is to train on."""
    made: set[tuple[type, str]] = set()
    for spec in specs:
        kind, arguments = resolve(spec)
        what = (kind, repr([arguments, normalization(spec)]))
        if what in made or spec.environment is not None or not can_be_made(spec, kind) or not _is_at_hand(spec):
            continue
        made.add(what)
        try:
            env = make_envs(spec, 1, spec.seed)
            try:
                make_small(kind, arguments, normalized(env, normalization(spec)), spec.seed)
            finally:
                env.close()
        except Exception as error:
            said = error if isinstance(error, ValueError) else _told(error)
            raise ValueError(f"{where}: {spec.cell}, {spec.algorithm}: {said}") from error


def _is_at_hand(spec: RunSpec) -> bool:
    """Whether a registered task can be made here: a dry run needs no simulator, and a batched one takes long to start."""
    env_id, _ = environment(spec)
    suite = suite_of(env_id)
    return not is_batched(env_id) and (suite is None or SUITES[suite].is_installed)


def can_be_made(spec: RunSpec, kind: type) -> bool:
    """
    :param spec: settings of a run
    :param kind: class of the run's algorithm
    :return: whether the algorithm can be made in this process and without another run's model, so before any run
    """
    return spec.needs is None and not issubclass(kind, Program)


def make_small(kind: type, arguments: Mapping[str, Any], env: VecEnv, seed: int) -> Any:
    """
    :param kind: class of an algorithm
    :param arguments: arguments of the algorithm, as YAML has them
    :param env: environment to train on
    :param seed: seed of the algorithm
    :return: model that needs little memory; an off-policy one takes no gradient step
    """
    small = {"buffer_size": 1_000, "learning_starts": 10**9, "n_epochs": 1}
    known = constructor_parameters(kind)
    given = {name: arguments.get(name, value) for name, value in small.items() if name in known}
    small = {name: small[name] for name, value in given.items() if _is_count(value)}  # the algorithm refuses others
    return kind(env=env, device="cpu", **{"policy": POLICY, **instantiate({**arguments, **small}), "seed": seed})


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


def reads_partial_alone(spec: RunSpec) -> bool:
    """
    :param spec: settings of a run
    :return: whether the policy that is deployed reads the entry ``partial`` and no other; a program's does, by its contract
    """
    kind, arguments = resolve(spec)
    if issubclass(kind, Program):
        return True
    roles = getattr(kind.policy_aliases[arguments.get("policy", POLICY)], "roles", None)  # type: ignore[attr-defined]
    if roles is None:  # a policy of SB3's, which reads every entry
        return False
    role_keys = arguments.get("role_keys") or arguments.get("policy_kwargs", {}).get("role_keys") or {}
    return set(role_keys.get(roles.deployed, (PARTIAL,))) == {PARTIAL}


def first_gradient_step(spec: RunSpec) -> int:
    """
    :param spec: settings of a run
    :return: number of environment steps after which gradient steps begin, 0 if the algorithm has no such argument
    """
    kind, arguments = resolve(spec)
    return int((defaults_of(kind) | arguments).get("learning_starts", 0))


def check_programs(specs: Iterable[RunSpec]) -> None:
    """
    Check that the programs that train outside of this process have the packages that they need.

    :param specs: settings of runs
    :raises ValueError: naming the packages that are missing, and the interpreter that lacks them
    """
    for name, spec in {spec.algorithm: spec for spec in specs}.items():
        kind, arguments = resolve(spec)
        if issubclass(kind, Program):
            try:
                kind(**arguments).versions()
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None


def check_simulators(specs: Iterable[RunSpec]) -> None:
    """
    Check that the simulators of registered tasks are installed.

    :param specs: settings of runs
    :raises ValueError: naming a task whose simulator is missing, and how to install it
    """
    for spec in {spec.task: spec for spec in specs if spec.environment is None}.values():
        suite = suite_of(environment(spec)[0])
        if suite is not None and not SUITES[suite].is_installed:
            raise ValueError(SUITES[suite].how_to_install(spec.task))


def try_out(where: str, spec: RunSpec) -> None:
    """
    Make a run's environment and its algorithm, and take one step. An algorithm that needs another run's model is not made.

    :param where: name of the suite, with which an error message begins
    :param spec: settings of a run
    :raises ValueError: with the type and the message of whatever error occurred
    """
    try:
        env = normalized(make_envs(spec, min(spec.envs, 2), spec.seed), normalization(spec))
        try:
            kind, arguments = resolve(spec)
            if can_be_made(spec, kind):
                model = make_small(kind, arguments, env, spec.seed)
                model.set_logger(Logger(None, []))
                model.learn(1, reset_num_timesteps=False)  # so that no training is expected of it
        finally:
            env.close()
    except Exception as error:
        raise ValueError(f"{where}, {spec.cell}, {spec.algorithm}: {_told(error)}") from error


def _told(error: Exception) -> str:
    """The type of an error, and its message; without a message, the line that raised it and its place."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {str(error).strip() or f'{last.line} ({last.filename}, line {last.lineno})'}"


def resolve(spec: RunSpec) -> tuple[type, dict[str, Any]]:
    """
    :param spec: settings of a run
    :return: class of the algorithm, and its arguments as YAML has them; those of a program are its definition's alone
    :raises ValueError: if an argument is unknown to the class or its policy, or is a number that YAML reads as text
    """
    kind, own = read_algorithm(spec.algorithm, spec.definition)
    if issubclass(kind, Program):
        return kind, _of_program(spec, kind, own)
    preset = read_preset(spec.preset)
    task = spec.task if spec.environment is None else None
    resolved: dict[str, Any] = {}
    if "buffer_size" in constructor_parameters(kind):
        resolved["buffer_size"] = min(1_000_000, max(spec.steps, 1_000))
    for layer in (*preset.layers(kind, task, spec.noise or 0.0), spec.overrides, own):
        resolved = merge(resolved, _present(spec.algorithm, kind, layer))
    needed = needed_runs(spec)
    if both := sorted(set(needed) & set(resolved)):
        raise ValueError(f"{spec.algorithm}: {both} are what it needs, and among its arguments too.")
    for name in sorted(_GIVEN_TO_RUNS.keys() & resolved.keys()):
        raise ValueError(f"{spec.algorithm}: {name} is no argument of a suite: {_GIVEN_TO_RUNS[name]}.")
    _check_known(spec.algorithm, {**resolved, **needed}, kind, {"env"})
    policies, policy = kind.policy_aliases, resolved.get("policy", POLICY)  # type: ignore[attr-defined]
    check_is(f"{spec.algorithm}: policy", policy, f"one of {sorted(policies)}", str, policies.get)
    for_policy = resolved.get("policy_kwargs") or {}
    check_is(f"{spec.algorithm}: policy_kwargs", for_policy, "a mapping, such as {net_arch: [64, 64]}", Mapping)
    of_policy = _present(f"{spec.algorithm}, policy_kwargs", policies[policy], for_policy)
    resolved |= {"policy_kwargs": of_policy} if of_policy else {}
    _check_known(f"{spec.algorithm}, policy_kwargs", of_policy, policies[policy], _GIVEN_TO_POLICIES)
    check_numbers(spec.algorithm, resolved)
    return kind, resolved


def _of_program(spec: RunSpec, kind: type[Program], own: dict[str, Any]) -> dict[str, Any]:
    _check_known(spec.algorithm, {**own, **needed_runs(spec)}, kind, set())
    check_numbers(spec.algorithm, own)
    if (options := normalization(spec)) is not None:
        raise ValueError(f"{spec.algorithm}: a program normalises by itself, or not at all; there is normalize: {options}.")
    try:
        kind(**own)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{spec.algorithm}: {error}") from None
    return own


def _present(where: str, kind: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments by their present names; a warning names those that were given by a former one."""
    try:
        present = present_names(kind, given, None)
    except TypeError as error:
        raise ValueError(f"{where}: {error}") from None
    for former in sorted(set(given) - set(present)):
        (now,) = present_names(kind, {former: None}, None)
        warnings.warn(f'{where}: "{former}" is "{now}" now.', FutureWarning, stacklevel=3)  # a suite's author sees it
    return present


def fingerprint(spec: RunSpec) -> str:
    """
    :param spec: settings of a run
    :return: eight hexadecimal digits that change with any setting of the run, any argument of its algorithm, and its
        normalisation
    """
    made_of = [asdict(spec), resolve(spec)[1], normalization(spec)]
    return sha256(json.dumps(made_of, sort_keys=True, default=str).encode()).hexdigest()[:8]


def _check_known(where: str, arguments: Mapping[str, Any], taker: type, given: set[str]) -> None:
    known = sorted(set(constructor_parameters(taker)) - given)
    unknown = sorted(map(str, set(arguments) - set(known)))
    if unknown:
        raise ValueError(f"{where}: {taker.__name__} has no arguments {unknown}; it has {known}.")
