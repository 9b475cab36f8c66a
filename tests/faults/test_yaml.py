"""YAML that would hang, fill memory or crash the reader is refused, in a moment, with file and line."""

import time
from contextlib import contextmanager
from typing import Annotated

import msgspec
import pytest

from factorlib.errors import InputError
from factorlib.yamlfile import Limits, load_yaml, parse_yaml, read_yaml

LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefghi", "bcdefghij"))
CHAIN = "a0: &a0 " + "[" * 60 + "]" * 60 + "\n" + "".join(f"a{i + 1}: &a{i + 1} [[[[[*a{i}]]]]]\n" for i in range(2000))


class Numbered(msgspec.Struct):
    number: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    table: dict[str, int] = {}


@contextmanager
def in_a_moment(seconds=10.0):
    begin = time.process_time()
    yield
    assert time.process_time() - begin < seconds


@pytest.mark.parametrize(
    "text, words",
    [
        (LAUGHS, "more than 2,000 values"),
        (CHAIN, "nested more than"),
        ("[" * 100_000, "nested more than 64 deep"),
        ("[" * 100_000 + "]" * 100_000, "nested more than 64 deep"),
        ("- " * 2000 + "a", "nested more than 64 deep"),
        ("{a: " * 500 + "1" + "}" * 500, "nested more than 64 deep"),
        ("[" + "a," * 100_000 + "]", "more than 2,000 values"),
        ("number: " + "1" * 5000, "a number of 5000 characters"),
        ("number: 0x" + "f" * 5000, "a number of 5002 characters"),
        ("number: !!int one", "'one' is no int"),
        ("number: !!float one", "'one' is no float"),
        ("number: !!bool maybe", "'maybe' is no bool"),
        ("number: !!python/tuple [1]", "the tag 'tag:yaml.org,2002:python/tuple' is not known"),
        ("number: *none", "no &none above"),
        ("number: 1\n---\nnumber: 2\n", "a second document"),
        ("number: \x07", "not YAML"),
        ("\x00\x00\x00", "not YAML"),
        ("%YAML 3.0\n---\nnumber: 1", "not YAML"),
    ],
    ids=range(18),
)
def test_it_is_refused_in_a_moment_with_its_line(tmp_path, text, words):
    file = tmp_path / "x.yaml"
    file.write_text(text)
    with in_a_moment(), pytest.raises(InputError) as caught:
        read_yaml(file, Numbered, Limits(values=2000))
    assert words in caught.value.found and str(caught.value.file).startswith(str(file)) and caught.value.cure
    assert len(str(caught.value)) < 1000


def test_a_file_too_large_is_not_read(tmp_path):
    with open(tmp_path / "x.yaml", "wb") as stream:
        stream.truncate(1 << 40)
    with in_a_moment(), pytest.raises(InputError, match=r"a YAML file has 64\.0 MB at most"):
        load_yaml(tmp_path / "x.yaml")


def test_a_wrong_value_among_thousands_is_found_in_a_moment(tmp_path):
    """msgspec does not say which key of a table is wrong."""
    file = tmp_path / "x.yaml"
    file.write_text("table:\n" + "".join(f"  k{i}: {'one' if i == 7000 else i}\n" for i in range(10_000)))
    with in_a_moment(), pytest.raises(InputError) as caught:
        read_yaml(file, Numbered)
    assert caught.value.key == "table.k7000" and caught.value.file == f"{file}:7002"


def test_an_unknown_key_made_of_the_converters_own_words_is_refused():
    class Strict(msgspec.Struct, forbid_unknown_fields=True):
        a: int = 0

    for key in ("x` - at `$.b[3]", "a\nb", "` - at `key in $[...]`", "x" * 100_000):
        from factorlib.yamlfile import convert

        with pytest.raises(InputError) as caught:
            convert({key: 1}, Strict, "x.yaml")
        assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("text", ["a: &x 1\nb: [*x, *x]", "a: !!str 5\nb: !!float 5", "", "---\na: 1\n...\n", "{a: &b {c: 1}, d: {e: *b}}"])
def test_what_is_good_stays_good(text):
    import yaml

    assert parse_yaml(text, "x.yaml") == yaml.safe_load(text)


@pytest.mark.long
def test_a_large_file_of_values_takes_no_gigabytes(tmp_path):
    import subprocess
    import sys

    file = tmp_path / "x.yaml"
    file.write_text("a: [" + "a," * 12_000_000 + "]")
    code = (
        "import resource; from factorlib.errors import InputError; from factorlib.yamlfile import load_yaml\n"
        f"try: load_yaml({str(file)!r})\nexcept InputError: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 500  # MB
