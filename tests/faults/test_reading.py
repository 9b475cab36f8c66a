"""The boundary of readers: what a parser raises, and what is no plain file, is an InputError with file, key and cure."""

import os
import struct

import pytest

from factorlib.errors import InputError
from factorlib.reading import check_plain, path_inside, read_bytes, read_text, reading


@pytest.mark.parametrize(
    "error, words",
    [
        (PermissionError(13, "Permission denied"), "cannot be read (Permission denied)"),
        (RecursionError("maximum recursion depth exceeded"), "nested too deeply"),
        (MemoryError(), "does not fit into memory"),
        (OverflowError("int too large\nto convert"), "(int too large to convert)"),
        (KeyError("nodes"), "(KeyError: 'nodes')"),
        (struct.error("unpack requires 4 bytes"), "(unpack requires 4 bytes)"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "invalid start byte"),
        (ModuleNotFoundError("No module named 'x'"), "No module named 'x'"),
    ],
)
def test_what_a_parser_raises_names_file_key_and_cure(error, words):
    with pytest.raises(InputError) as caught, reading("a mesh", "chair.obj", "meshes.chair.file"):
        raise error
    assert words in caught.value.found and "\n" not in caught.value.found
    assert caught.value.file == "chair.obj" and caught.value.key == "meshes.chair.file" and caught.value.cure


def test_a_clear_error_passes_as_it_is_and_a_stop_too():
    clear = InputError("part without material", file="a.obj")
    with pytest.raises(InputError) as caught, reading("a mesh", "b.obj"):
        raise clear
    assert caught.value is clear
    with pytest.raises(KeyboardInterrupt), reading("a mesh", "b.obj"):
        raise KeyboardInterrupt


def test_a_pipe_a_device_and_a_folder_are_never_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "pipe"), ("/dev/zero", "device"), (tmp_path, "folder")):
        with pytest.raises(InputError, match=f"is a {kind}, not a file"):
            read_bytes(path, "a mask")


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    with open(tmp_path / "sparse", "wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(InputError, match="a mask has 1,073.7 MB at most"):
        read_bytes(tmp_path / "sparse", "a mask")


def test_what_is_not_there_or_is_no_text_is_said(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        check_plain(tmp_path / "nothing", "a mask")
    (tmp_path / "latin").write_bytes("Möbel".encode("latin-1"))
    with pytest.raises(InputError, match=r"not UTF-8 text \(byte 1\)"):
        read_text(tmp_path / "latin", "a list")


def test_a_file_and_a_folder_that_another_user_may_not_read(open_folder, as_other_user):
    (open_folder / "closed").mkdir()
    for path in (open_folder / "own", open_folder / "closed" / "own"):
        path.write_text("a")
        path.chmod(0o600)
    (open_folder / "closed").chmod(0o700)
    with as_other_user():
        for path in (open_folder / "own", open_folder / "closed" / "own"):
            with pytest.raises(InputError, match="Permission denied") as caught:
                read_bytes(path, "a mask", "masks")
            assert "chmod" in caught.value.cure


def test_a_path_that_no_file_system_can_follow(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for path in ("a", "a/x.png", "x\0y", "y" * 256, "y" * 256 + "/x.png", "é" * 200, "z/" * 5000):
        with pytest.raises(ValueError, match="no path that can be followed"):
            path_inside(tmp_path, path)


def test_a_path_that_leads_outside(tmp_path):
    (tmp_path / "out").symlink_to("/etc/passwd")
    (tmp_path / "later").symlink_to("/nowhere/x")
    for path in ("out", "later", "../x", "", "/etc/passwd", "a/../../x"):
        with pytest.raises(ValueError, match="leads outside"):
            path_inside(tmp_path, path)
    assert path_inside(tmp_path, "a/../b c/ü.png") == tmp_path / "a/../b c/ü.png"
