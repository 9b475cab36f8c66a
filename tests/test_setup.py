"""Set-up: what it says where something is missing."""

import pytest

from factorlib import setup


def test_found_is_silent(monkeypatch, capsys):
    monkeypatch.setattr(setup, "LIBRARIES", {})
    setup.check_system()
    assert capsys.readouterr() == ("", "")


def test_missing_is_one_message_with_the_command(monkeypatch):
    monkeypatch.setattr(setup, "LIBRARIES", {"libnone.so.9": "libnone9"})
    monkeypatch.setattr(setup.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(setup.shutil, "which", lambda name: f"/usr/bin/{name}" if name == "apt-get" else None)
    with pytest.raises(SystemExit) as caught:
        setup.check_system()
    assert "libnone.so.9" in caught.value.code and "sudo apt-get update && sudo apt-get install -y libnone9" in caught.value.code


def test_another_python_is_refused(monkeypatch):
    monkeypatch.setattr(setup.sys, "version_info", (3, 9, 1))
    with pytest.raises(SystemExit, match=r"3\.11 or 3\.12"):
        setup.check_system()


def test_an_index_that_does_not_answer_is_not_used():
    assert not setup.answers("http://localhost:9/none/")
    assert not setup.answers("no address")


def test_extras_are_installed_alone(monkeypatch):
    called = []
    monkeypatch.setattr(setup, "pip", lambda *words: called.append(words))
    monkeypatch.setenv("EXTRAS", "blender, interchange")
    setup.install_extras()
    ((command, alone, *packages),) = called
    assert (command, alone) == ("install", "--no-deps")
    assert [package.split("=")[0].split(">")[0] for package in packages] == ["bpy", "MaterialX", "usd-core"]


def test_an_extra_with_packages_of_its_own_gets_them_and_moves_none_of_the_lock(monkeypatch):
    called = []
    monkeypatch.setattr(setup, "pip", lambda *words: called.append(words))
    monkeypatch.setenv("EXTRAS", "dask blender")
    setup.install_extras()
    alone, (command, how, lock, *packages) = called
    assert alone[1] == "--no-deps" and (command, how, lock) == ("install", "-c", str(setup.LOCK))
    assert [package.split(">")[0] for package in packages] == ["cloudpickle", "dask", "dask-jobqueue", "distributed"]


def test_an_extra_that_is_not_there_is_refused_with_those_that_are(monkeypatch):
    monkeypatch.setenv("EXTRAS", "blunder")
    with pytest.raises(SystemExit, match=r"'blunder'.*blender, interchange"):
        setup.install_extras()


SAY = "import sys, time\nfor k in range(3):\n    print(f\"WARNING: Location 'file:///x/{word}{k}/' is ignored\", file=sys.stderr)\n"


@pytest.fixture
def installing(monkeypatch, tmp_path):
    """`install` with a Python program in place of a package client."""
    monkeypatch.setattr(setup, "site_packages", lambda: tmp_path)
    monkeypatch.setattr(setup, "BEAT", 0.3)
    monkeypatch.setattr(setup, "_shown", 0.0)
    return lambda *programs: setup.install([[setup.sys.executable, "-c", program] for program in programs], 9)


def test_warnings_of_the_package_client_are_shown_once(installing, capfd):
    assert installing(SAY.replace("{word}", "a"), SAY.replace("{word}", "b"))
    said = capfd.readouterr()
    assert said.err.count("WARNING: Location") == 1 and "5 more warnings of the same kind left out" in said.out


def test_a_warning_of_another_kind_and_every_error_are_shown(installing, capfd):
    assert not installing(SAY.replace("{word}", "") + "print('WARNING: other', file=sys.stderr)\nprint('ERROR: no such package a', file=sys.stderr)\nsys.exit(1)", "pass")
    said = capfd.readouterr().err
    assert said.count("WARNING") == 2 and "ERROR: no such package a" in said


def test_a_silent_installation_shows_that_it_lives(installing, capfd, tmp_path):
    (tmp_path / "pip-1.0.dist-info").mkdir()
    assert installing(f"import os, time; os.mkdir({str(tmp_path / 'one-1.0.dist-info')!r}); time.sleep(1.5)")
    assert 2 <= capfd.readouterr().out.count("set-up: 1 of 9 packages installed") <= 8


def test_installations_run_at_once(installing, tmp_path):
    met = "import pathlib, sys, time\nhere = pathlib.Path({!r})\n(here / {!r}).touch()\nfor _ in range(400):\n    if (here / {!r}).exists(): sys.exit(0)\n    time.sleep(.05)\nsys.exit(1)"
    assert installing(met.format(str(tmp_path), "a", "b"), met.format(str(tmp_path), "b", "a")), "each waits for the other"


@pytest.fixture
def called(monkeypatch, tmp_path):
    """What `install_packages` would run: lists of commands.  There is no uv, and PyTorch's index of CPU wheels answers."""
    calls = []
    monkeypatch.setattr(setup, "install", lambda commands, total=0: calls.append(commands) or True)
    monkeypatch.setattr(setup, "site_packages", lambda: tmp_path)
    monkeypatch.setattr(setup.shutil, "which", lambda name: None)
    monkeypatch.setattr(setup, "torch_index", lambda: setup.TORCH_CPU)
    return calls


def test_every_package_of_the_lock_is_installed_once_and_torch_apart(called, tmp_path):
    setup.install_packages()
    ((torch, *others),) = called
    assert all("--no-deps" in command for command in (torch, *others)) and setup.TORCH in torch
    packages = [word for command in others for word in command if "==" in word]
    locked = [line for line in setup.LOCK.read_text().splitlines() if line and not line.startswith("#")]
    assert sorted(packages) == sorted(locked)
    assert (tmp_path / "factorlib.pth").read_text() == "../../../..\n"


def test_a_torch_of_another_index_is_asked_what_it_needs(called, monkeypatch):
    monkeypatch.setattr(setup, "torch_index", lambda: "https://example.org/cuda")
    setup.install_packages()
    assert called[-1] == [setup.with_pip(["-c", str(setup.LOCK), setup.TORCH, "--index-url", "https://example.org/cuda"])]


@pytest.mark.parametrize("index, torch_by", [(setup.TORCH_CPU, "uv"), (None, "pip")])
def test_uv_is_used_where_it_is_there_and_pip_where_it_fails(called, monkeypatch, index, torch_by):
    monkeypatch.setattr(setup, "install", lambda commands, total=0: called.append(commands) or len(called) > 1)
    monkeypatch.setattr(setup.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(setup, "torch_index", lambda: index)
    setup.install_packages()
    (torch, others), by_pip = called[:2]
    assert others[0] == "uv" and (torch[0] == "uv") == (torch_by == "uv") and setup.TORCH in torch
    assert all(command[1:3] == ["-m", "pip"] for command in by_pip)
