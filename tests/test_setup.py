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
    assert [package.split(">")[0] for package in packages] == ["cloudpickle", "dask-jobqueue", "distributed"]


def test_an_extra_that_is_not_there_is_refused_with_those_that_are(monkeypatch):
    monkeypatch.setenv("EXTRAS", "blunder")
    with pytest.raises(SystemExit, match=r"'blunder'.*blender, interchange"):
        setup.install_extras()
