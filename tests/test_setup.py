"""Set-up: which commands it gives to package clients, and what it says where something is missing."""

import os
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from factorlib import setup


def test_a_library_that_is_missing_is_one_message_with_the_command_and_root_installs_it(monkeypatch, capsys):
    """On a machine that lacks a library of each kind and has apt-get, for another user than root and for root."""
    monkeypatch.setattr(setup, "NEEDED", {"libnone.so.9": "libnone9"})
    monkeypatch.setattr(setup, "FASTER", {"libfast.so.1": "libfast1"})
    monkeypatch.setattr(setup.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(setup.shutil, "which", lambda name: f"/usr/bin/{name}" if name == "apt-get" else None)
    with pytest.raises(SystemExit, match=r"do not load"):
        setup.check_system()
    output = capsys.readouterr().out
    assert (
        "libnone.so.9, libfast.so.1" in output
        and "apt-get update && sudo apt-get install -y libnone9 libfast1" in output
    )
    there = {"libnone.so.9"}
    monkeypatch.setattr(setup, "loads", lambda name: name in there)
    setup.check_system()
    assert "the system libraries libfast.so.1 are missing" in capsys.readouterr().out
    there.clear()
    calls = []
    monkeypatch.setattr(setup.os, "geteuid", lambda: 0)
    install = lambda command, **_: calls.append(command[-1]) or there.update(setup.NEEDED, setup.FASTER)  # noqa: E731
    monkeypatch.setattr(setup.subprocess, "run", install)
    setup.check_system()
    assert len(calls) == 1 and capsys.readouterr().out == ""
    assert "update; apt-get" in calls[0] and calls[0].endswith(" libnone9 libfast1")
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
    """The packages and options that are to be installed.  PyTorch's index of CPU wheels answers."""
    calls = []
    (tmp_path / "lib/python3.11/site-packages").mkdir(parents=True)
    monkeypatch.setattr(setup, "install", lambda *words, index=None: calls.append([*words, index]))
    monkeypatch.setattr(setup.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1))
    monkeypatch.setattr(setup, "VENV", tmp_path)
    monkeypatch.setattr(setup, "answers", lambda url: True)
    monkeypatch.delenv("TORCH_INDEX", raising=False)
    return calls


@pytest.mark.parametrize("extras, expected", [
    ("blender, interchange", [["--no-deps", "bpy"], ["--no-deps", "MaterialX"]]),
    ("dask blender", [["-c", "dask", "distributed"], ["--no-deps", "bpy"]]),
])  # fmt: skip
def test_extras_are_installed_alone_or_move_nothing_of_the_lock(called, monkeypatch, extras, expected):
    monkeypatch.setenv("EXTRAS", extras)
    setup.install_extras()
    bare = [[word.split("=")[0].split(">")[0] for word in words[:-1] if word != str(setup.LOCK)] for words in called]
    assert bare == expected
    monkeypatch.setenv("EXTRAS", "dusk")
    with pytest.raises(SystemExit, match="there is no extra 'dusk'"):
        setup.install_extras()


def test_the_lock_is_installed_and_torch_apart_from_its_index(called, monkeypatch, tmp_path, capsys):
    setup.install_packages()
    locked = ["--no-deps", "-r", str(setup.LOCK), None]
    assert called == [locked, ["--no-deps", setup.TORCH, setup.TORCH_CPU]]
    assert f"no {setup.UV_PIN} here" in capsys.readouterr().out
    assert next(tmp_path.rglob("factorlib.pth")).read_text() == "../../../..\n"
    monkeypatch.setenv("TORCH_INDEX", "https://example.org/cuda")
    setup.install_packages()
    assert called[2:] == [locked, ["-c", str(setup.LOCK), setup.TORCH, "https://example.org/cuda"]]
    monkeypatch.delenv("TORCH_INDEX")
    monkeypatch.setattr(setup, "answers", lambda url: False)
    setup.install_packages()
    assert called[4:] == [locked, ["-c", str(setup.LOCK), setup.TORCH, None]]


@pytest.mark.parametrize(
    "codes", [{"uv": 0}, {"uv": 1, "python": 0}, {"python": 0}, {"uv": 1, "python": 1}, {"python": 1}]
)
def test_pip_installs_where_uv_is_missing_or_fails(monkeypatch, tmp_path, codes):
    called = []
    for name in codes:
        (tmp_path / name).touch()

    def run(command, env):
        assert command[-1] == "torch" and set(env.values()) == {"https://example.org/cuda"}
        called.append(os.path.basename(command[0]))
        return SimpleNamespace(returncode=codes[called[-1]])

    for name, value in {"UV": tmp_path / "uv", "PYTHON": tmp_path / "python", "uv_environment": dict}.items():
        monkeypatch.setattr(setup, name, value)
    monkeypatch.setattr(setup.subprocess, "run", run)
    with pytest.raises(SystemExit, match="could not be installed") if all(codes.values()) else nullcontext():
        setup.install("torch", index="https://example.org/cuda")
    assert called == list(codes)


def test_uv_is_told_what_pip_is_configured_for(monkeypatch, tmp_path):
    for name in [name for name in os.environ if name.startswith(("PIP_", "UV_", "SSL_CERT"))]:
        monkeypatch.delenv(name)
    (tmp_path / "pip.conf").write_text(
        "[global]\nindex-url = https://example.org/simple\nextra-index-url =\n  https://a.example\n  https://b.example\n"
        "find-links = /wheels /more\ncert = /ca.pem\nproxy = http://name:it's@proxy:80\ntimeout = 60\n"
        "[install]\nindex-url = https://example.org/install\n[download]\ncert = /other.pem\n"
    )
    monkeypatch.setenv("PIP_CONFIG_FILE", str(tmp_path / "pip.conf"))
    expected = {
        "UV_INDEX_STRATEGY": "unsafe-best-match",
        "UV_DEFAULT_INDEX": "https://example.org/install",
        "UV_INDEX": "https://a.example https://b.example",
        "UV_FIND_LINKS": "/wheels,/more",
        "SSL_CERT_FILE": "/ca.pem",
        "ALL_PROXY": "http://name:it's@proxy:80",
    }
    assert expected.items() <= setup.uv_environment().items()
    monkeypatch.setenv("PIP_INDEX_URL", "https://example.org/env")
    monkeypatch.setenv("UV_FIND_LINKS", "/mine")
    expected |= {"UV_DEFAULT_INDEX": "https://example.org/env", "UV_FIND_LINKS": "/mine"}
    assert expected.items() <= setup.uv_environment().items()
