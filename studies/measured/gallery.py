"""Page docs/gallery.md, a picture of every recipe of data/eames: `make results ONLY=gallery`.

Recipes are the files in recipes/ and recipes/eames/: a new one appears by itself.
"""

from pathlib import Path

import numpy as np
from PIL import Image

from factorlib.errors import InputError
from factorlib.wholefile import write_text
from studies.measured.tools import ROOT, run_verb

PAGE = ROOT / "docs" / "gallery.md"
DATASET = "eames"
PHOTO = "terrace"  # whose pictures are shown where a recipe makes them of all photos
SIDE = 240  # pixels of the longer side of one of four pictures; twice as many of a single one
HEAD = """# Gallery

The first command makes every picture of this page from a result of `data/eames`, the second one of them:

```
make render DATASET=eames RECIPE=all
make render DATASET=eames RECIPE=insert
```

Pictures are written to `build/eames/recipes/<recipe>/`; [recipes](recipes.md) describes their fields. Of a recipe \
for every photograph this page shows the `terrace`,
of four pictures or more, such as frames of an animation, four. `make results ONLY=gallery` writes the page.
"""
FIGURE = """<figure markdown="0" style="margin: 0">
<img src="gallery/{name}.jpg" alt="{caption}" width="{width}" height="{height}">
<figcaption><strong>{name}</strong>: {caption}<br><code>make render DATASET={dataset} RECIPE={name}</code></figcaption>
</figure>"""
GRID = (
    '<div style="display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 300px), 1fr)); gap: 1.5rem">'
)


def write() -> Path:
    """Render all recipes that are not current, write the page and its pictures, and return the page."""
    run_verb("render", DATASET, RECIPE="all")
    recipes = {path.stem: path for folder in ("", DATASET) for path in (ROOT / "recipes" / folder).glob("*.yaml")}
    (ROOT / "docs" / "gallery").mkdir(exist_ok=True)
    figures = [figure(recipes[name]) for name in sorted(recipes)]
    write_text(PAGE, "\n".join([HEAD, GRID, *figures, "</div>\n"]))
    return PAGE


def figure(recipe: Path) -> str:
    """Write the picture of a recipe; return its HTML.

    The caption is the recipe's first line, a comment, and what the picture's parts are.
    Raises InputError if the first line is not a comment.
    """
    first = recipe.read_text("utf-8").partition("\n")[0]
    if not first.startswith("# "):
        raise InputError("the first line does not say what the recipe shows", file=recipe, cure="begin it with `# …`")
    folder = ROOT / "build" / DATASET / "recipes" / recipe.stem
    files = sorted(folder.rglob("*.png"))
    files = [file for file in files if Path(file.relative_to(folder).parts[0]).stem == PHOTO] or files
    files = [files[k * len(files) // 4] for k in range(4)] if len(files) >= 4 else files[:1]
    picture = sheet(files)
    picture.save(ROOT / "docs" / "gallery" / f"{recipe.stem}.jpg", quality=85, optimize=True)
    width, height = picture.size
    caption = first[2:] + parts_of(files)
    return FIGURE.format(name=recipe.stem, caption=caption, width=width, height=height, dataset=DATASET)


def parts_of(files: list[Path]) -> str:
    """Name the lights of the pictures in `files`; frames and single pictures have no such names."""
    names = [file.stem for file in files]
    return "" if len(names) == 1 or names[0].isdigit() else f" Here, row by row: {', '.join(names)}."


def sheet(files: list[Path]) -> Image.Image:
    """Return one picture, or four of one size two by two, on white, cropped to the pixels that any of them covers."""
    across = 1 if len(files) == 1 else 2
    pictures = [Image.open(file).convert("RGBA") for file in files]
    boxes = np.array([box for picture in pictures if (box := picture.getchannel("A").getbbox())])
    crop = (*boxes[:, :2].min(0).tolist(), *boxes[:, 2:].max(0).tolist())
    pictures = [picture.crop(crop) for picture in pictures]
    for picture in pictures:
        picture.thumbnail((2 * SIDE // across, 2 * SIDE // across))
    width, height = pictures[0].size
    page = Image.new("RGBA", (across * width, across * height), "white")
    for k, picture in enumerate(pictures):
        page.alpha_composite(picture, (k % 2 * width, k // 2 * height))
    return page.convert("RGB")
