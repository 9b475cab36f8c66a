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
    with pytest.raises(SystemExit, match=r"do not load"):
        setup.check_system()
    output = capsys.readouterr().out
    assert (
        "libnone.so.9, libfast.so.1" in output
        and "apt-get update && sudo apt-get install -y libnone9 libfast1" in output
    )
    calls, there = [], {"libnone.so.9"}
    lacking.setattr(setup, "loads", lambda name: name in there)
    setup.check_system()
    assert "the system libraries libfast.so.1 are missing" in capsys.readouterr().out
    there.clear()
    lacking.setattr(setup.os, "geteuid", lambda: 0)
    install = lambda command, **_: calls.append(command[-1]) or there.update(setup.NEEDED, setup.FASTER)  # noqa: E731
    lacking.setattr(setup.subprocess, "run", install)
    setup.check_system()
    assert calls == ["update", "libfast1"] and capsys.readouterr().out == ""
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
    """The packages and options that pip would be called with.  PyTorch's index of CPU wheels answers."""
    calls = []
    (tmp_path / "lib/python3.11/site-packages").mkdir(parents=True)
    monkeypatch.setattr(setup, "pip", lambda *words: calls.append(list(words)))
    monkeypatch.setattr(setup, "VENV", tmp_path)
    monkeypatch.setattr(setup, "answers", lambda url: True)
    monkeypatch.delenv("TORCH_INDEX", raising=False)
    return calls


@pytest.mark.parametrize("extras, expected", [
    ("blender, interchange", [["--no-deps", "bpy"], ["--no-deps", "MaterialX", "usd-core"]]),
    ("dask blender", [["-c", "cloudpickle", "dask", "dask-jobqueue", "distributed"], ["--no-deps", "bpy"]]),
])  # fmt: skip
def test_extras_are_installed_alone_or_move_nothing_of_the_lock(called, monkeypatch, extras, expected):
    monkeypatch.setenv("EXTRAS", extras)
    setup.install_extras()
    bare = [[word.split("=")[0].split(">")[0] for word in words if word != str(setup.LOCK)] for words in called]
    assert bare == expected
    monkeypatch.setenv("EXTRAS", "dusk")
    with pytest.raises(SystemExit, match="there is no extra 'dusk'"):
        setup.install_extras()


def test_the_lock_is_installed_and_torch_apart_from_its_index(called, monkeypatch, tmp_path):
    setup.install_packages()
    locked = ["--no-deps", "-r", str(setup.LOCK)]
    assert called == [locked, ["--no-deps", setup.TORCH, "--index-url", setup.TORCH_CPU]]
    assert next(tmp_path.rglob("factorlib.pth")).read_text() == "../../../..\n"
    monkeypatch.setenv("TORCH_INDEX", "https://example.org/cuda")
    setup.install_packages()
    assert called[2:] == [locked, ["-c", str(setup.LOCK), setup.TORCH, "--index-url", "https://example.org/cuda"]]
    monkeypatch.delenv("TORCH_INDEX")
    monkeypatch.setattr(setup, "answers", lambda url: False)
    setup.install_packages()
    assert called[4:] == [locked, ["-c", str(setup.LOCK), setup.TORCH]]
