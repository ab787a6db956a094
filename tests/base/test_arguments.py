"""Constructors: shared arguments are written once, signatures have them all, and a subclass adds its own."""

import inspect
import pydoc
import re
import warnings

import pytest
from typing_extensions import Unpack

from sb3_gac import GAC, TGRL, AsymmetricSAC, GACShare, GACWithoutQ
from sb3_gac.base.arguments import OffPolicyArguments, PositionalArguments
from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.checks.values import check_not_negative
from tests.helpers import TwoViewBandit, small_model
from tests.registry import classes

ALGORITHMS = classes("replay")
HOW = ["load", "resume"]
SHARED = list(OffPolicyArguments.__annotations__)
BY_POSITION = ["policy", "env", *PositionalArguments.__annotations__]
GACS_OWN = [
    name for name, parameter in inspect.signature(GAC).parameters.items() if name not in SHARED and name not in BY_POSITION
]


def _saved(how, model, path):
    """The model, written down."""
    path.mkdir(exist_ok=True)
    if how == "load":
        model.save(path / "model")
    else:
        model.save_checkpoint(path)
    return path


def _again(how, cls, path, **given):
    if how == "load":
        return cls.load(path / "model", env=TwoViewBandit(), device="cpu", **given)
    return cls.resume(path, TwoViewBandit(), device="cpu", **given)


# --- signatures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", [*ALGORITHMS, AsymmetricOffPolicyAlgorithm])
def test_the_signature_has_all_arguments_those_behind_sb3s_by_name_alone(cls):
    parameters = inspect.signature(cls).parameters
    own = [name for name in parameters if name not in SHARED and name not in BY_POSITION]
    assert issubclass(cls, GAC) == (own == GACS_OWN)
    assert list(parameters) == [*BY_POSITION, *own, *SHARED[len(BY_POSITION) - 2 :]]
    by_position = [name for name, each in parameters.items() if each.kind is each.POSITIONAL_OR_KEYWORD]
    assert by_position == BY_POSITION
    assert all(each.kind is each.KEYWORD_ONLY for name, each in parameters.items() if name not in BY_POSITION)
    assert parameters["env"].default is inspect.Parameter.empty
    assert (parameters["tau"].default, parameters["tau"].annotation) == (0.005, float)
    assert list(inspect.signature(cls.__init__).parameters) == ["self", *parameters]


def test_help_shows_them():
    shown = pydoc.render_doc(GAC, renderer=pydoc.plaintext)
    for text in ("learning_rate: float", "= 0.0003", "target_kl: float", "= 0.0033", "max_grad_norm: float | None = 1.0"):
        assert text in shown


@pytest.mark.parametrize("cls", [GAC, AsymmetricOffPolicyAlgorithm])
def test_every_argument_is_described_where_it_is_written(cls):
    described = set(re.findall(r":param (\w+):", cls.__doc__))
    assert described == (set(GACS_OWN) if cls is GAC else {"policy", "env", *SHARED})


@pytest.mark.parametrize("cls", classes("replay", "temperature"))
def test_by_position_is_by_name(cls):
    values = [1e-3, 500, 7, 8, 0.1, 0.9, (3, "step"), 2, None, None, {"storage_dtype": "float16"}, False, 2, 0.3, 5, -2.0]
    assert len(values) == len(BY_POSITION) - 2
    if cls is TGRL:
        values[BY_POSITION.index("n_steps") - 2] = 1  # it takes no other
    by_position = cls("MultiInputPolicy", TwoViewBandit(), *values)
    by_name = cls(policy="MultiInputPolicy", env=TwoViewBandit(), **dict(zip(BY_POSITION[2:], values, strict=True)))
    for name, value in zip(BY_POSITION[2:], values, strict=True):
        assert getattr(by_position, name) == getattr(by_name, name), name
        if name not in ("train_freq", "replay_buffer_class"):
            assert getattr(by_position, name) == value, name


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_more_by_position_or_one_twice_is_pythons_type_error(cls):
    values = [parameter.default for parameter in list(inspect.signature(cls).parameters.values())[2 : len(BY_POSITION)]]
    with pytest.raises(TypeError, match="too many positional arguments"):
        cls("MultiInputPolicy", TwoViewBandit(), *values, 1.0)
    with pytest.raises(TypeError, match="multiple values for argument 'learning_rate'"):
        cls("MultiInputPolicy", TwoViewBandit(), 1e-3, learning_rate=1e-3)
    with pytest.raises(TypeError, match="'env'"):
        cls("MultiInputPolicy")


#: What is no argument -> what the message says
UNKNOWN = {
    "learning_rat": 'Is "learning_rate" meant',
    "max_grad_nrm": 'Is "max_grad_norm" meant',
    "n_critics": "one of policy_kwargs",
    "n_envs": "follows from env",
    "strict_deployment": "Set it on the model itself",
    "use_sde": "no state-dependent exploration .* Leave it out",
    "colour": "It takes policy, env, .*learning_rate",
}


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_what_is_no_argument_is_refused_by_name(cls):
    has_target = "target_kl" in inspect.signature(cls).parameters
    unknown = UNKNOWN | ({"target_kll": 'Is "target_kl" meant'} if has_target else {"target_kl": ""})
    for name, hint in unknown.items():
        with pytest.raises(
            TypeError, match=rf'^{cls.__name__}\(\) got "{name}", which is no argument of {cls.__name__}\. .*{hint}'
        ):
            small_model(cls=cls, **{name: 3})


@pytest.mark.parametrize(
    ("name", "hint"),
    [("log_std_init", 'it takes net_arch, .* Is "log_std_bounds" meant'), ("colour", "it takes net_arch, activation_fn, ")],
)
def test_what_is_no_argument_of_the_policy_is_refused_as_one_of_policy_kwargs(name, hint):
    with pytest.raises(TypeError, match=f'^policy_kwargs has "{name}", which is no argument of .*Policy: {hint}'):
        small_model(policy_kwargs={name: -3})


# --- a subclass with arguments of its own -------------------------------------------------------------------------------


class _OneMore:
    """As a part of several algorithms; it is their constructor."""

    argument_checks = {"coef_step": check_not_negative}  # noqa: RUF012

    def __init__(self, policy, env, *sb3, teacher, coef_step=0.01, **shared):
        self.teacher, self.coef_step = teacher, coef_step
        super().__init__(policy, env, *sb3, **shared)

    def _check_arguments(self):
        super()._check_arguments()
        assert self.teacher is not None, "made without a teacher"


class TaughtGAC(_OneMore, GAC):
    pass


class TaughtShare(_OneMore, GACShare):
    pass


class TaughtSAC(AsymmetricSAC):
    argument_checks = {"coef_step": check_not_negative}  # noqa: RUF012

    def __init__(self, policy, env, *sb3, teacher, coef_step=0.01, **shared: Unpack[OffPolicyArguments]):
        self.teacher, self.coef_step, self.spelled = teacher, coef_step, teacher.upper()
        super().__init__(policy, env, *sb3, **shared)


TAUGHT = [TaughtGAC, TaughtShare, TaughtSAC]


@pytest.mark.parametrize("cls", TAUGHT)
def test_a_subclass_has_one_more_argument(cls):
    parameters = inspect.signature(cls).parameters
    inherited = inspect.signature(cls.__mro__[2] if cls is not TaughtSAC else AsymmetricSAC).parameters
    assert list(parameters) == [*BY_POSITION, "teacher", "coef_step", *list(inherited)[len(BY_POSITION) :]]
    assert parameters["teacher"].default is inspect.Parameter.empty
    model = cls("MultiInputPolicy", TwoViewBandit(), 1e-3, teacher="wise", buffer_size=100)
    assert (model.learning_rate, model.teacher, model.coef_step, model.buffer_size) == (1e-3, "wise", 0.01, 100)
    with pytest.raises(TypeError, match="missing 1 required keyword-only argument: 'teacher'"):
        small_model(cls=cls)
    with pytest.raises(ValueError, match="coef_step must be a number >= 0"):
        small_model(cls=cls, teacher="wise", coef_step=-1)
    with pytest.raises(TypeError, match=f'no argument of {cls.__name__}. Is "coef_step" meant'):
        small_model(cls=cls, teacher="wise", coef_stp=1)


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("cls", TAUGHT)
def test_a_subclass_with_a_needed_argument_is_saved_loaded_and_resumed(how, cls, tmp_path):
    model = small_model(cls=cls, teacher="wise", coef_step=0.5, gamma=0.8).learn(20)
    again = _again(how, cls, _saved(how, model, tmp_path))
    assert (again.teacher, again.coef_step, again.gamma) == ("wise", 0.5, 0.8)
    assert again.learn(5, reset_num_timesteps=False)._n_updates > model._n_updates
    other = _again(how, cls, tmp_path, teacher="wiser", coef_step=0.25)
    assert (other.teacher, other.coef_step) == ("wiser", 0.25)
    if cls is TaughtSAC and how == "resume":
        assert other.spelled == "WISER"
    with pytest.raises(TypeError, match='Is "teacher" meant'):
        _again(how, cls, tmp_path, teachr="wiser")


@pytest.mark.parametrize("cls", TAUGHT)
def test_a_needed_argument_that_the_file_does_not_hold_is_to_be_given(cls, tmp_path):
    small_model(cls=cls, teacher="wise").save(tmp_path / "model", exclude=["teacher"])
    with pytest.raises(TypeError, match="missing 1 required keyword-only argument: 'teacher'"):
        _again("load", cls, tmp_path)
    assert _again("load", cls, tmp_path, teacher="wiser").teacher == "wiser"
    with pytest.raises(TypeError, match="'teacher'"):  # what the file before held is forgotten
        small_model(cls=cls)


class _Shorter(GAC):
    """Has another default for a shared argument, which it therefore names."""

    def __init__(self, *args, batch_size=8, **shared):
        super().__init__(*args, batch_size=batch_size, **shared)


def test_a_subclass_with_another_default_takes_by_position_what_comes_before():
    parameters = inspect.signature(_Shorter).parameters
    by_position = [name for name, each in parameters.items() if each.kind is each.POSITIONAL_OR_KEYWORD]
    assert by_position == ["policy", "env", "learning_rate", "buffer_size", "learning_starts"]
    assert set(parameters) == set(inspect.signature(GAC).parameters)
    assert parameters["batch_size"].default == _Shorter("MultiInputPolicy", TwoViewBandit(), 1e-3, 50, 3).batch_size == 8


def test_other_constructors_have_the_signature_that_they_have():
    class Fixed(GAC):
        def __init__(self, env, width: int = 8):
            super().__init__("MultiInputPolicy", env, policy_kwargs={"net_arch": [width]}, buffer_size=50)

    class WithDefault(GAC):
        def __init__(self, policy="MultiInputPolicy", *args, **kwargs):
            super().__init__(policy, *args, **kwargs)

    assert list(inspect.signature(Fixed).parameters) == ["env", "width"]
    assert Fixed(TwoViewBandit()).policy.net_arch == [8]
    assert set(inspect.signature(WithDefault).parameters) == set(inspect.signature(GAC).parameters)
    assert WithDefault(env=TwoViewBandit(), buffer_size=50).buffer_size == 50


# --- former names -------------------------------------------------------------------------------------------------------


class _Former:
    renamed_arguments = {"polyak": "tau", "temperature": "ent_coef"}  # noqa: RUF012


class RenamedGAC(_Former, GAC):
    renamed_arguments = {"bound": "target_kl"}  # noqa: RUF012


class RenamedSAC(_Former, AsymmetricSAC):
    pass


FORMER = {"polyak": ("tau", 0.5), "temperature": ("ent_coef", 0.25)}
RENAMED = {RenamedGAC: FORMER | {"bound": ("target_kl", 0.125)}, RenamedSAC: FORMER}


def _saved_as_before(how, model, path, monkeypatch):
    """As an earlier version wrote it down."""
    renamed = {present: former for former, (present, _) in RENAMED[type(model)].items()}
    if how == "load":
        for present, former in renamed.items():
            vars(model)[former] = vars(model).pop(present)
    else:
        encoded = model._encoded_arguments
        monkeypatch.setattr(
            type(model), "_encoded_arguments", lambda _, arrays: {renamed.get(k, k): v for k, v in encoded(arrays).items()}
        )
    _saved(how, model, path)


@pytest.mark.parametrize("cls", RENAMED)
def test_former_names_are_taken_by_the_constructor_with_a_warning(cls):
    for former, (present, value) in RENAMED[cls].items():
        with pytest.warns(DeprecationWarning, match=rf'{cls.__name__}\(\) got "{former}", which is "{present}" now') as caught:
            model = small_model(cls=cls, **{former: value})
        assert getattr(model, present) == value
        assert len(caught) == 1
        with pytest.raises(TypeError, match=f'got "{present}" twice, also by its former name: leave "{former}" out'):
            small_model(cls=cls, **{former: value, present: value})
        with pytest.warns(DeprecationWarning, match=f"{cls.__name__}.{former} is {cls.__name__}.{present} now"):
            assert getattr(model, former) == value
        with pytest.warns(DeprecationWarning, match=f"{former} is"):
            setattr(model, former, 0.75)
        assert getattr(model, present) == 0.75
    assert not set(RENAMED[cls]) & set(inspect.signature(cls).parameters)


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("cls", RENAMED)
def test_former_names_are_taken_by_load_and_resume_with_a_warning(how, cls, tmp_path):
    _saved(how, small_model(cls=cls).learn(15), tmp_path)
    for former, (present, value) in RENAMED[cls].items():
        with pytest.warns(DeprecationWarning, match=rf'{how}\(\) got "{former}", which is "{present}" now') as caught:
            model = _again(how, cls, tmp_path, **{former: value})
        assert caught[0].filename == __file__
        assert getattr(model, present) == value
        assert former not in vars(model)
        assert model.ent_coef != 0.25 or model.ent_coef_tensor.item() == 0.25
        with pytest.raises(TypeError, match=f'"{present}" twice'):
            _again(how, cls, tmp_path, **{former: value, present: value})


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("cls", RENAMED)
def test_files_with_former_names_are_read_without_a_warning(how, cls, tmp_path, monkeypatch):
    values = dict(RENAMED[cls].values())
    model = small_model(cls=cls, **values).learn(15)
    _saved_as_before(how, model, tmp_path, monkeypatch)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        again = _again(how, cls, tmp_path)
        given = _again(how, cls, tmp_path, tau=0.75)
    assert {name: getattr(again, name) for name in values} == values
    assert given.tau == 0.75
    assert not set(RENAMED[cls]) & set(vars(again))


GUIDED = [GAC, GACShare, GACWithoutQ]


@pytest.mark.parametrize("cls", GUIDED)
def test_std_of_is_shared_std(cls, tmp_path):
    with pytest.warns(DeprecationWarning, match=rf'{cls.__name__}\(\) got "std_of", which is "shared_std" now'):
        model = small_model(cls=cls, std_of="guider").learn(5)
    assert model.shared_std == model.policy.constructor_options["shared_std"] == "guider"
    with pytest.warns(DeprecationWarning, match=f"{cls.__name__}.std_of is {cls.__name__}.shared_std now"):
        assert model.std_of == "guider"
    for how in HOW:
        _saved(how, model, tmp_path / how)
        with pytest.warns(DeprecationWarning, match=rf'{how}\(\) got "std_of"'):
            assert _again(how, cls, tmp_path / how, std_of="guider").shared_std == "guider"


@pytest.mark.parametrize("cls", GUIDED)
def test_std_of_in_files(cls, tmp_path, monkeypatch):
    monkeypatch.setitem(RENAMED, cls, {"std_of": ("shared_std", "guider")})
    for how in HOW:
        model = small_model(cls=cls, shared_std="guider").learn(15)
        (tmp_path / how).mkdir()
        _saved_as_before(how, model, tmp_path / how, monkeypatch)
        again = _again(how, cls, tmp_path / how)
        assert again.shared_std == again.policy.constructor_options["shared_std"] == "guider"
        assert not again.policy.learner.owns_std


def test_std_of_of_a_policy_is_shared_std(tmp_path):
    with pytest.warns(DeprecationWarning, match='policy_kwargs got "std_of", which is "shared_std" now'):
        model = small_model(policy_kwargs={"net_arch": [8], "std_of": "guider"})
    assert not model.policy.learner.owns_std
    model.save(tmp_path / "model")
    with pytest.warns(DeprecationWarning, match='policy_kwargs got "std_of"'):
        assert not GAC.load(tmp_path / "model").policy.learner.owns_std
    options = model.policy.constructor_options
    options["std_of"] = options.pop("shared_std")
    model.policy.save(tmp_path / "policy")
    with pytest.warns(DeprecationWarning, match=r'GACPolicy\(\) got "std_of", which is "shared_std" now'):
        loaded = type(model.policy).load(tmp_path / "policy")
    assert loaded.constructor_options["shared_std"] == "guider"
    parameters = inspect.signature(type(model.policy)).parameters
    assert {"shared_std", "n_critics"} <= set(parameters)
    assert "std_of" not in parameters
