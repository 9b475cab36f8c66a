"""Set-up: which commands it gives to package clients, and what it says where something is missing."""

import pytest

from factorlib import setup


@pytest.fixture
def lacking(monkeypatch):
    """A machine that lacks a library of each kind, has apt-get, and whose user is not root."""
    monkeypatch.setattr(setup, "NEEDED", {"libnone.so.9": "libnone9"})
    monkeypatch.setattr(setup, "FASTER", {"libfast.so.1": "libfast1"})
    monkeypatch.setattr(setup.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(setup.shutil, "which", lambda name: f"/usr/bin/{name}" if name == "apt-get" else None)
    return monkeypatch


def test_a_library_that_is_missing_is_one_message_with_the_command_and_root_installs_it(lacking, capsys):
    with pytest.raises(SystemExit, match=r"libnone.so.9(.|\n)*sudo apt-get update && sudo apt-get install -y libnone9"):
        setup.check_system()
    calls, there = [], {"libnone.so.9"}
    lacking.setattr(setup, "loads", lambda name: name in there)
    setup.check_system()
    assert "three times faster" in (said := capsys.readouterr().out) and "install -y libfast1" in said
    there.clear()
    lacking.setattr(setup.os, "geteuid", lambda: 0)
    install = lambda command, **_: calls.append(command[-1]) or there.update(setup.NEEDED, setup.FASTER)  # noqa: E731
    lacking.setattr(setup.subprocess, "run", install)
    setup.check_system()
    assert calls == ["update", "libnone9"] and capsys.readouterr().out == "set-up: installing libnone9\n"
    setup.check_system()
    assert capsys.readouterr() == ("", "")


def test_another_python_is_refused(monkeypatch, tmp_path):
    for name in ("READY", "VENV", "PYTHON"):  # so that no failure of this test takes the environment away
        monkeypatch.setattr(setup, name, tmp_path / name)
    monkeypatch.setattr(setup.sys, "version_info", (3, 9, 1))
    with pytest.raises(SystemExit, match=r"3\.11 or 3\.12"):
        setup.make_venv()


@pytest.fixture
def called(monkeypatch, tmp_path):
    """The commands that would be run, by runs.  There is no uv, and PyTorch's index of CPU wheels answers."""
    calls = []
    monkeypatch.setattr(setup, "run", lambda commands, words: calls.append(commands) or "uv" not in commands[0])
    monkeypatch.setattr(setup, "site_packages", lambda: tmp_path)
    monkeypatch.setattr(setup.shutil, "which", lambda name: None)
    monkeypatch.setattr(setup, "answers", lambda url: True)
    monkeypatch.delenv("TORCH_INDEX", raising=False)
    return calls


@pytest.mark.parametrize("extras, alone, others", [
    ("blender, interchange", ["bpy", "MaterialX", "usd-core"], []),
    ("dask blender", ["bpy"], ["cloudpickle", "dask", "dask-jobqueue", "distributed"]),
])  # fmt: skip
def test_extras_are_installed_alone_or_move_nothing_of_the_lock(called, monkeypatch, extras, alone, others):
    monkeypatch.setenv("EXTRAS", extras)
    setup.install_extras()
    bare = [[word.split("=")[0].split(">")[0] for word in command] for (command,) in called]
    assert bare[0][-len(alone) - 1 :] == ["--no-deps", *alone]
    assert not others or bare[1][-len(others) - 2 :] == ["-c", str(setup.LOCK), *others]


def test_without_uv_pip_installs_the_lock_and_torch_apart(called, monkeypatch, tmp_path):
    setup.install_packages()
    locked, torch = called[-1]
    assert all(command[1:3] == ["-m", "pip"] and "--no-deps" in command for command in (locked, torch))
    assert locked[-2:] == ["-r", str(setup.LOCK)] and torch[-3:] == [setup.TORCH, "--index-url", setup.TORCH_CPU]
    assert (tmp_path / "factorlib.pth").read_text() == "../../../..\n"
    monkeypatch.setenv("TORCH_INDEX", "https://example.org/cuda")
    setup.install_packages()
    more = ["-c", str(setup.LOCK), setup.TORCH, "--index-url", "https://example.org/cuda"]
    assert called[-1] == [setup.with_pip(more)]


@pytest.mark.parametrize("reached, torch_by", [(True, "/bin/uv"), (False, "pip")])
def test_uv_is_used_where_it_is_there_and_pip_where_it_fails(called, monkeypatch, reached, torch_by):
    monkeypatch.setattr(setup, "run", lambda commands, words: called.append(commands) or len(called) > 1)
    monkeypatch.setattr(setup.shutil, "which", lambda name: "/bin/uv")
    monkeypatch.setattr(setup, "answers", lambda url: reached)
    setup.install_packages()
    (locked, torch), by_pip = called[:2]
    assert locked[0] == "/bin/uv" and torch_by in torch and setup.TORCH in torch
    assert all(command[1:3] == ["-m", "pip"] for command in by_pip)
