"""The page that asks: one HTML file, its pictures in it, which needs no network.

Order      of the questions and the side of each candidate: by a generator (mulberry32) of the participant's own random seed, which is kept.
Answers    by the keys ← and →, or by clicking a picture; a question shows nothing of the methods' names.
Results    at the end, as JSON (what `answers` reads) and as CSV (for spreadsheets), saved from the browser's memory.
Simulated  empty for a person.  Otherwise who answered: the words after #simulated= in the address, or that a program drives the browser.
"""

from __future__ import annotations

import base64
from pathlib import Path

import jinja2

from factorlib.jsonfile import json_text
from studies.user_study.answers import FORMAT
from studies.user_study.pictures import Trial, digest

TEMPLATE = Path(__file__).parent / "templates" / "user_study.html"


def page(found: list[Trial], label: str = "") -> str:
    """HTML.  label: what stands on the page of a quick study."""
    asked = [
        {
            "name": t.name,
            "reference": _data(t.reference),
            "ours": _data(t.ours),
            "other": _data(t.other),
            "dssim": [t.dssim_ours, t.dssim_other],
        }
        for t in found
    ]
    data = json_text({"format": FORMAT, "page": digest(found), "pictures": asked}).replace("</", "<\\/")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        data=data, label=label, count=len(found)
    )


def _data(file: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(file.read_bytes()).decode()
