"""Every parameter of every stage says what it means, what it may be and what it is by default."""

from __future__ import annotations

import importlib
from typing import Annotated

import msgspec
import pytest

from factorlib.runner import verbs
from factorlib.runner.params import parameters
from factorlib.runner.pipeline import read_pipeline
from factorlib.runner.project import LIBRARY, Project, photo_sets

STAGES = read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices).order()


class Inner(msgspec.Struct, frozen=True):
    size: Annotated[int, msgspec.Meta(ge=1, le=9)] = 3
    """Of what
    is inside."""


class Base(msgspec.Struct):
    share: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.5
    """A share."""


class Outer(Base):
    inner: Inner = Inner()
    mute: bool = False


def test_fields_of_bases_and_of_fields_are_there():
    found = [(p.name, p.allowed, p.default, p.text) for p in parameters(Outer)]
    expected = [
        ("share", "number > 0 and < 1", "0.5", "A share."),
        ("inner.size", "1 … 9", "3", "Of what is inside."),
        ("mute", "true, false", "false", ""),
    ]
    assert found == expected


@pytest.mark.parametrize("stage", STAGES)
def test_every_parameter_of_a_stage_says_what_it_means(stage):
    params = importlib.import_module(f"stages.{stage}").Params
    mute = [one.name for one in parameters(params) if not one.text.endswith(".")]
    assert not mute


def test_the_verb_shows_them(capsys):
    assert verbs.show_params(Project(LIBRARY, photo_sets()), ["urm"]) == 0
    said = capsys.readouterr().out
    assert "urm.directions = 512    (0 … 4,096)\n    Directions of the sphere" in said
