"""`python -m studies.pairs page build/eames …` makes pairs and a page about them; `… analyse FILE …` reads what participants saved.

The page is one HTML file that needs no network.  Order and sides are by a generator (mulberry32) of the participant's own random seed, which is
kept.  Answers are saved as JSON; who answered is empty for a person, else the words after #simulated= in the address, or that a program drives
the browser.  The observer of `studies.pairs.scene` names the inserted picture of a pair that it tells apart, and tosses a coin for all others.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import jinja2
import msgspec
import numpy as np
import typer

from factorlib import load_result
from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError
from factorlib.images.picture import picture, png_bytes
from factorlib.jsonfile import json_text, write_json
from factorlib.reading import read_text
from factorlib.render.solved_set import SolvedSet
from factorlib.wholefile import write_bytes, write_text
from studies.figures import Mark, drawn
from studies.measured.tools import ROOT
from studies.pairs import scene

FORMAT, OBSERVER, HOME = 1, "the observer of studies/pairs, by mean ΔE", ROOT / "build/studies/pairs"
CURE = "give files as the page saved them (the button “Save answers”), each once, of one page, people's by themselves"
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
Side = Literal["left", "right"]
LEAST_PAIRS = 10  # fewer answers of one participant make no share


class Answer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pair, on which side its inserted picture was, and which side was chosen."""

    pair: str
    inserted: Side
    chosen: Side


class Answers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A participant's.  page: digest of the questions;  simulated: empty for a person;  asked: questions of the page"""

    format: Literal[FORMAT]
    page: str
    participant: str
    seed: int
    simulated: str
    asked: int
    answers: list[Answer]


def read_answers(files: Sequence[Path]) -> list[Answers]:
    """A participant's a file.

    Raises InputError for a file that is not the page's, one that is cut short or changed, the same participant twice, and where
    files are of different pages, or simulated answers stand beside people's.
    """
    read: dict[str, Answers] = {}
    for file in files:
        try:
            one = msgspec.json.decode(read_text(file, "JSON"), type=Answers)
        except msgspec.DecodeError as error:  # also a ValidationError, which says the field
            raise InputError(f"not a file of answers: {error}", file=file, cure=CURE) from None
        pairs, first = {answer.pair for answer in one.answers}, next(iter(read.values()), one)
        if not len(pairs) == len(one.answers) == one.asked > 0:
            raise InputError(f"{len(pairs)} pairs answered, of {one.asked}", file=file, cure=CURE)
        if one.participant in read or (one.page, one.simulated) != (first.page, first.simulated):
            found = f"of the same participant, of another page or otherwise simulated than in {files[0]}"
            raise InputError(found, file=file, cure=CURE)
        read[one.participant] = one
    return list(read.values())


def summary(everyone: Sequence[Answers]) -> str:
    """How often the inserted picture was named, by pair and over all, and the share told apart: twice the excess over a coin's half.

    The standard error is over participants, whose answers are no independent votes; of one participant, over the pairs.
    """
    votes = [{a.pair: a.chosen == a.inserted for a in one.answers} for one in everyone]
    lines = [f"{pair}: {sum(of[pair] for of in votes)} of {len(votes)}" for pair in sorted(votes[0])]
    shares = [np.mean([*of.values()]) for of in votes] if len(votes) > 1 else [*votes[0].values()]
    share, error = 100 * np.mean(shares), 100 * np.std(shares) / max(len(shares) - 1, 1) ** 0.5
    if len(votes) == 1 and len(shares) < LEAST_PAIRS:
        return "\n".join([*lines, f"{len(shares)} pairs are too few to say a share: ask of {LEAST_PAIRS}"])
    who = f"simulated: {everyone[0].simulated}" if everyone[0].simulated else f"{len(everyone)} participants"
    lines.append(f"{who}: the inserted picture is named in {share:.0f} ± {error:.0f} % of answers (chance: 50 %)")
    return "\n".join([*lines, f"told apart: {2 * share - 100:.0f} ± {2 * error:.0f} %"])


def simulated(rows: Sequence[dict], page: str, seed: int) -> Answers:
    """The answers of the observer."""
    coins = np.where(np.random.default_rng(seed).random(len(rows)) < 0.5, "left", "right").tolist()
    sides = ["left" if row["told_apart"] else coin for row, coin in zip(rows, coins, strict=True)]
    answers = [Answer(row["pair"], "left", side) for row, side in zip(rows, sides, strict=True)]
    return Answers(FORMAT, page, "observer", seed, OBSERVER, len(rows), answers)


def write(home: Path, rows: Sequence[dict], pictures: Sequence[tuple[bytes, bytes]], seed: int) -> Answers:
    """Write the page, the table, the figure and the observer's answers, which are returned.

    rows: of the table, `scores` among them;  pictures: PNGs of each pair, the inserted one and the truth
    """
    digest = hashlib.sha256(b"".join(png for pair in pictures for png in pair)).hexdigest()[:16]
    data = [["data:image/png;base64," + base64.b64encode(png).decode() for png in pair] for pair in pictures]
    pairs = [{"name": row["pair"], "object": row["object"], "pictures": of} for row, of in zip(rows, data, strict=True)]
    facts = json_text({"format": FORMAT, "page": digest, "pairs": pairs}).replace("</", "<\\/")
    template = Path(__file__).with_name("pairs.html").read_text(encoding="utf-8")
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(template)
    columns = {"mean ΔE (floor dashed)": {k: Mark(row["difference"], null=row["floor"]) for k, row in enumerate(rows)}}
    columns |= {f"only the {f} recovered": {k: Mark(row[f]) for k, row in enumerate(rows)} for f in scene.FACTORS}
    title = f"{sum(row['told_apart'] for row in rows)} of {len(rows)} pairs are told apart"
    table, answers = io.StringIO(), simulated(rows, digest, seed)
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(home / "index.html", page.render(data=facts, count=len(pairs)))
    write_text(home / "figure.svg", drawn(title, [f"{row['pair']} {row['object']}" for row in rows], columns))
    write_text(home / "pairs.csv", table.getvalue())
    write_json(home / "answers-simulated.json", answers)
    return answers


@app.command()
def page(
    results: Annotated[list[Path], typer.Argument(help="results of made sets of chairs, such as build/eames")],
    count: Annotated[int, typer.Option(min=1, help="pairs")] = 20,
    samples: Annotated[int, typer.Option(min=1, help="a pixel")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="of what is inserted where")] = 39,
) -> None:
    """Make pairs: build/studies/pairs/index.html, pairs.csv, figure.svg, pictures/, and the simulated observer's answers."""
    (HOME / "pictures").mkdir(parents=True, exist_ok=True)
    rows, pictures, sets = [], [], {}
    with TemporaryDirectory() as folder:
        files = scene.write_files(Path(folder))
        for result in results:
            loaded = load_result(result)
            inputs = msgspec.structs.replace(loaded._solved.inputs, files=loaded._solved.inputs.files | files)
            dataset = read_dataset(ROOT / read_text(loaded.folder / "dataset.txt", "a path").strip())
            sets[loaded.folder.name] = SolvedSet(inputs), scene.Truth(inputs, dataset)
        for name, photo, recipe in scene.chosen(sets, count, samples, seed):
            both, scores = scene.drawn(photo, recipe, *sets[name])
            words = f"{recipe.material} {Path(recipe.mesh).stem}"
            what = {"pair": f"{len(rows) + 1:02}-{name}-{photo}", "object": words}
            rows.append(what | {k: round(v, 4) if isinstance(v, float) else v for k, v in scores.items()})
            pictures.append(tuple(png_bytes(picture(of, 1.0)) for of in both))
            for kind, png in zip(("inserted", "true"), pictures[-1], strict=True):
                write_bytes(HOME / "pictures" / f"{what['pair']}-{kind}.png", png)
            print(f"  {what['pair']}, {words}: ΔE {scores['difference']:.1f}", flush=True)
    print(f"{summary([write(HOME, rows, pictures, seed)])}\n  {HOME / 'index.html'}")


@app.command()
def analyse(files: Annotated[list[Path], typer.Argument(help="answers-*.json, a file a participant")]) -> None:
    """Print how often the inserted picture was named, with standard errors."""
    print(summary(read_answers(files)))


if __name__ == "__main__":
    try:
        app(prog_name="python -m studies.pairs")
    except InputError as error:
        sys.exit(f"error: {error}")
