"""The table of environments that ``python -m sb3_gac.envs`` prints."""

import sys

import pytest

from sb3_gac.envs import suites
from sb3_gac.envs.__main__ import main
from sb3_gac.envs.table import Row, in_columns, rows, steps_per_second


def _cells(text):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]


def test_every_environment_is_in_it_with_its_shapes(capsys):
    main([])
    header, _, *lines = _cells(capsys.readouterr().out)
    assert header == ["id", "suite", "partial", "privileged", "actions", "installed"]
    assert {line[0] for line in lines} == {env_id for suite in suites.SUITES.values() for env_id in suite.environments}
    found = {line[0]: line for line in lines}
    assert found["sb3_gac/Ant-v5"] == ["sb3_gac/Ant-v5", "mujoco", "13", "27", "8", "yes"]
    assert found["sb3_gac/T1JoystickFlatTerrain-v0"][2:5] == ["85", "180", "23"]


def test_what_is_missing_says_how_to_install_it_and_keeps_the_shapes_that_are_known(monkeypatch):
    monkeypatch.setattr(suites, "find_spec", lambda module: None)
    (robot,) = rows("Go1Getup")
    assert robot == Row("sb3_gac/Go1Getup-v0", "playground", "42", "91", "12", 'pip install -e ".[envpool]"')
    game = next(rows("popgym-MineSweeperEasy"))
    assert game[2:] == ("?", "?", "?", 'pip install -e ".[popgym]"')
    assert next(rows("Ant"))[5] == "yes", "MuJoCo is no extra"


def test_a_suite_is_installed_if_its_simulator_is_found(monkeypatch):
    monkeypatch.setitem(sys.modules, "envpool", None)
    assert not suites.SUITES["playground"]._replace(simulator="no_such_module").is_installed
    assert suites.SUITES["playground"]._replace(simulator="json").is_installed
    assert suites.SUITES["mujoco"].is_installed


def test_ids_are_found_in_small_letters_and_what_is_none_is_said(capsys):
    main(["pendulum-V1"])
    assert [line[0] for line in _cells(capsys.readouterr().out)[2:]] == ["sb3_gac/Pendulum-v1"]
    with pytest.raises(SystemExit, match="None of the registered environments' ids contains 'nosuch'"):
        main(["nosuch"])


@pytest.mark.parametrize("options", [["--envs", "4", "0"], ["--seconds", "0"], ["--seconds", "nan"]])
def test_a_measurement_of_nothing_is_refused(options, capsys):
    with pytest.raises(SystemExit):
        main(["sb3_gac/Pendulum-v1", "--speed", *options])
    assert f"{options[0]}: must be" in capsys.readouterr().err


def test_speed_is_measured_of_what_is_installed(capsys):
    main(["sb3_gac/Pendulum", "--speed", "--envs", "2", "3", "--seconds", "0.02"])
    header, _, line = _cells(capsys.readouterr().out)
    assert header[-2:] == ["steps/s, 2", "steps/s, 3"]
    assert all(float(number.replace(",", "")) > 0 for number in line[-2:])


def test_steps_of_all_environments_are_counted(monkeypatch):
    clock = iter(range(10**6))
    monkeypatch.setattr("sb3_gac.envs.table.time.perf_counter", lambda: next(clock))
    assert steps_per_second("sb3_gac/Pendulum-v1", 4, seconds=40.0) == pytest.approx(4 * 39 / 41)


def test_a_terminal_of_80_columns_has_room_for_what_is_installed_and_a_line_for_each_other_suite(monkeypatch, capsys):
    monkeypatch.setattr(suites, "find_spec", lambda module: None if module in ("popgym", "brax") else module)
    monkeypatch.setattr("sb3_gac.envs.table._shapes", lambda *of: ("3x64x64", "12", "23"))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    main([])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    number = len(suites.SUITES["popgym"].environments)
    assert f'popgym: {number} environments, not installed: pip install -e ".[popgym]"' in lines
    assert not any("sb3_gac/popgym" in line for line in lines)
    assert "mujoco" in lines
    assert any(line.startswith("sb3_gac/Ant-v5 ") for line in lines)
    main(["brax-ant"])
    heading, header, row, _ = capsys.readouterr().out.splitlines()
    assert heading == 'brax: 1 environments, not installed: pip install -e ".[brax]"'
    assert header.split() == ["id", "partial", "privileged", "actions"]
    assert row.split() == ["sb3_gac/brax-Ant-v0", "3x64x64", "12", "23"]


def test_columns_are_as_wide_as_their_widest_cell():
    assert in_columns(["a", "number"], [["long", "1"]]) == "| a    | number |\n| ---- | ------ |\n| long | 1      |"
