"""sb3-gac: which programs there are, how they are called, and what is said of those that there are not."""

import configparser
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

import sb3_gac.__main__
from sb3_gac import GAC
from sb3_gac.__main__ import BENCHMARKS, PROGRAMS, main
from tests.helpers import small_model

ROOT = Path(__file__).parents[1]


def test_the_installed_command_is_this_one():
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    name, _, target = parser["options.entry_points"]["console_scripts"].strip().partition(" = ")
    module, _, function = target.partition(":")
    assert name == sb3_gac.__main__.NAME
    assert getattr(import_module(module), function) is main


def test_help_lists_all_programs_and_takes_no_time_for_torch():
    program = """
import sys, sb3_gac.__main__ as program
try:
    program.main(["--help"])
finally:
    print([name for name in ("torch", "mujoco", "matplotlib") if name in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    *listed, imported = result.stdout.splitlines()
    assert imported == "[]"
    for name, about in PROGRAMS.items():
        assert any(line.split()[:1] == [name] and line.endswith(about.summary) for line in listed), name


def test_no_argument_is_help_and_the_version_is_known(capsys):
    main([])
    assert "usage: sb3-gac COMMAND" in capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"sb3_gac {sb3_gac.__version__}\n"


def test_a_name_that_is_none_is_told_what_may_be_meant():
    with pytest.raises(SystemExit, match=r'There is no command "evalute"\. Is "evaluate" meant\?'):
        main(["evalute", "x"])
    with pytest.raises(SystemExit, match="There are train, evaluate, compare"):
        main(["qqq"])
    with pytest.raises(SystemExit, match=r'There is no program "agregate"\. Is "aggregate" meant\?'):
        main(["bench", "agregate"])


@pytest.mark.parametrize("name", [name for name in PROGRAMS if name != "bench"])
def test_a_program_reads_what_follows_its_name(name, monkeypatch):
    """As under python -m, and its usage says how it was called."""
    called, before = [], list(sys.argv)
    module = sb3_gac.__main__._module(name)
    if name != "zoo":  # which needs an extra
        assert callable(import_module(module).main)
    monkeypatch.setitem(sys.modules, module, SimpleNamespace(main=lambda: called.append((list(sys.argv), sys.path[0]))))
    monkeypatch.setattr(sb3_gac.__main__, "import_module", lambda name: sys.modules[name])
    main([name, "--steps", "3"])
    assert called == [([f"sb3-gac {name}", "--steps", "3"], str(Path.cwd()))]
    assert sys.argv == before


def test_programs_are_run_by_python_m_as_well():
    for program in PROGRAMS.values():
        path = ROOT / program.module.replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists() or path.name == "benchmarks"
    assert all((ROOT / "benchmarks" / f"{name}.py").exists() for name in BENCHMARKS)


def test_the_benchmarks_are_run_from_a_clone(monkeypatch, capsys):
    run = []
    monkeypatch.setattr(
        sb3_gac.__main__.runpy, "run_module", lambda module, run_name: run.append((module, run_name, list(sys.argv)))
    )
    monkeypatch.setattr(sys, "path", list(sys.path))
    main(["bench", "launch", "a.yml"])
    assert run == [("benchmarks.launch", "__main__", ["sb3-gac bench launch", "a.yml"])]
    main(["bench", "--help"])
    assert "launch, aggregate, report" in capsys.readouterr().out


def test_without_a_clone_it_is_said_that_there_are_no_benchmarks(monkeypatch, tmp_path):
    monkeypatch.setattr(sb3_gac.__main__, "__file__", str(tmp_path / "site-packages/sb3_gac/__main__.py"))
    with pytest.raises(SystemExit, match="not installed with the package: clone the repository"):
        main(["bench", "launch"])


def test_an_extra_that_is_missing_is_a_sentence_and_a_module_that_is_missing_an_error(monkeypatch):
    def missing(error):
        def fail(name):
            raise error

        monkeypatch.setattr(sb3_gac.__main__, "import_module", fail)

    missing(ImportError('sb3_gac.zoo needs rl_zoo3: pip install -e ".[zoo]".'))
    with pytest.raises(SystemExit, match="needs rl_zoo3"):
        main(["zoo", "train"])
    missing(ModuleNotFoundError("No module named 'x'", name="x"))
    with pytest.raises(ModuleNotFoundError):
        main(["zoo", "train"])


def test_a_program_that_is_stopped_says_so_in_a_line(monkeypatch, capsys):
    def stopped(name):
        raise KeyboardInterrupt

    monkeypatch.setattr(sb3_gac.__main__, "import_module", stopped)
    with pytest.raises(SystemExit) as end:
        main(["evaluate"])
    assert end.value.code == 130
    assert capsys.readouterr().err == "\nStopped.\n"


def test_a_model_is_exported_by_a_command(tmp_path, capsys, monkeypatch):
    small_model().save(tmp_path / "model.zip")
    main(["export", str(tmp_path), str(tmp_path / "x.pt"), "--unit", "action=N m"])
    assert "the deployed policy of GAC, which reads partial" in capsys.readouterr().out
    assert (tmp_path / "x.pt").stat().st_size > 1000
    wrong = {
        ("nowhere", "x.pt"): "no file or directory",
        (tmp_path, tmp_path / "x.tar"): r'must end in "\.onnx"',
        (tmp_path, tmp_path / "x.pt", "--unit", "privileged=m"): "units names",
        (tmp_path, tmp_path / "x.pt", "--vec-normalize", "nowhere"): "the model was trained without VecNormalize",
        (tmp_path, tmp_path / "x.pt" / "y.pt"): "x.pt",
    }
    for arguments, message in wrong.items():
        with pytest.raises(SystemExit, match=message):
            main(["export", *map(str, arguments)])
    with pytest.raises(SystemExit):
        main(["export", str(tmp_path), "x.pt", "--unit", "action"])
    assert "--unit: must be ENTRY=UNIT" in capsys.readouterr().err
    (tmp_path / "folder.pt").mkdir()
    with pytest.raises(SystemExit):
        main(["export", str(tmp_path), str(tmp_path / "folder.pt")])
    assert "folder.pt is a directory: name a file in it" in capsys.readouterr().err


@pytest.mark.parametrize("is_beside", [False, True])
def test_an_exported_policy_has_the_statistics_of_vec_normalize(is_beside, tmp_path):
    import numpy as np
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from sb3_gac.evaluation.policies import load_exported
    from tests.helpers import TwoViewBandit

    env = VecNormalize(DummyVecEnv([TwoViewBandit]))
    model = GAC("MultiInputPolicy", env, buffer_size=100, policy_kwargs={"net_arch": [4]}, device="cpu").learn(5)
    env.obs_rms["partial"].mean[:], env.obs_rms["partial"].var[:] = 2.0, 9.0
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "statistics.pkl"))
    export = ["export", str(tmp_path), str(tmp_path / "x.pt")]
    with pytest.raises(SystemExit, match=r"there is no vecnormalize\.pkl beside .*: pass --vec-normalize"):
        main(export)
    for missing in ("nowhere", str(tmp_path)):
        with pytest.raises(SystemExit, match=f"--vec-normalize: there is no file {missing}"):
            main([*export, "--vec-normalize", missing])
    main([*export, "--vec-normalize", str(tmp_path / "statistics.pkl")])
    if is_beside:
        (tmp_path / "x.pt").unlink()
        (tmp_path / "statistics.pkl").rename(tmp_path / "vecnormalize.pkl")
        main(export)
    policy = load_exported(tmp_path / "x.pt")
    policy.start(1)
    raw = np.array([[5.0, -1.0]], np.float32)
    expected, _ = model.predict({"partial": (raw - 2) / 3}, deterministic=True)
    np.testing.assert_allclose(policy.act({"partial": raw}, np.ones(1, bool)), expected, atol=1e-4)


def test_no_statistics_are_asked_for_of_what_an_exported_policy_does_not_read(tmp_path, capsys):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from tests.helpers import TwoViewBandit

    env = VecNormalize(DummyVecEnv([TwoViewBandit]), norm_obs_keys=["privileged"])
    model = GAC("MultiInputPolicy", env, buffer_size=100, policy_kwargs={"net_arch": [4]}, device="cpu").learn(5)
    model.save(tmp_path / "model")
    main(["export", str(tmp_path), str(tmp_path / "x.pt")])
    assert "which reads partial; its actions were compared" in capsys.readouterr().out


def test_all_entries_that_a_policy_reads_are_normalised_in_its_file(tmp_path):
    import numpy as np
    from gymnasium import spaces
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from sb3_gac.evaluation.policies import load_exported
    from tests.helpers import Sampled

    entries = spaces.Dict({name: spaces.Box(-9, 9, (2,), np.float32) for name in ("partial", "privileged", "proprio")})
    env = VecNormalize(DummyVecEnv([lambda: Sampled(entries)]))
    arguments = {"role_keys": {"learner": ["partial", "proprio"]}, "policy_kwargs": {"net_arch": [4]}, "device": "cpu"}
    model = GAC("MultiInputPolicy", env, buffer_size=100, **arguments).learn(5)
    env.obs_rms["proprio"].mean[:], env.obs_rms["proprio"].var[:] = 2.0, 9.0
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "vecnormalize.pkl"))
    main(["export", str(tmp_path), str(tmp_path / "x.pt")])
    policy = load_exported(tmp_path / "x.pt")
    policy.start(1)
    raw = {name: np.array([[5.0, -1.0]], np.float32) for name in entries.spaces}
    expected, _ = model.predict(env.normalize_obs(raw), deterministic=True)
    found = policy.act({name: raw[name] for name in policy.entries}, np.ones(1, bool))
    np.testing.assert_allclose(found, expected, atol=1e-4)
