"""Command line of the generator: python -m factorlib.generate synthetic|eames.

It writes the data sets in the repository, or others of the same protocol.
"""

import argparse
import sys
from pathlib import Path
from shutil import rmtree

from factorlib.errors import InputError
from factorlib.images.light_map import maps_in
from factorlib.wholefile import disk_error, sync_tree

SETS = {
    "synthetic": "three materials in three lights on exact shapes, with direct light only",
    "eames": "six photos of moulded side chairs, path-traced with all bounces, on an approximate mesh",
}


def main() -> None:
    """Generate into a folder beside the one named, then rename it; an error ends the program with its message."""
    about = "; ".join(f"{name}: {text}" for name, text in SETS.items())
    parser = argparse.ArgumentParser("python -m factorlib.generate", description=f"Generate a data set. {about}.")
    parser.add_argument("set", choices=SETS)
    seed = "0 is the set the project carries; others have other materials, views and lights"
    parser.add_argument("--seed", type=int, default=0, help=seed)
    parser.add_argument("--out", type=Path, help="folder to write; default data/<set>. It is replaced")
    parser.add_argument("--lights", type=Path, help="folder of lat-long .hdr or .exr maps to light the set with")
    parser.add_argument("--exact", action="store_true", help="eames: give the photographed mesh, its poses and focals")
    painted = "eames: paint wood and two shells: grain, a print, a patina; with true albedo"
    parser.add_argument("--painted", action="store_true", help=painted)
    options = parser.parse_args()
    if options.seed < 0:
        parser.error("argument --seed: 0 or more")
    if (options.exact or options.painted) and (options.set != "eames" or options.out is None):
        parser.error("--exact and --painted are options of eames, which need --out: data/eames is the set without them")
    out = options.out or Path("data", options.set)
    fresh = out.with_name(out.name + ".new")
    try:
        _generate(options, out, fresh)
    except (InputError, OSError) as error:
        known = error if isinstance(error, InputError) else disk_error(error, fresh)
        if known is None:
            raise
        sys.exit(f"error: {known}")
    rmtree(out, ignore_errors=True)
    fresh.rename(out)
    print(f"{out}: {sum(path.stat().st_size for path in out.rglob('*') if path.is_file()) / 1e6:.1f} MB")


def _generate(options: argparse.Namespace, out: Path, fresh: Path) -> None:
    """Generate the set into the folder `fresh`; InputError if `out` holds anything but a data set."""
    from factorlib.generate import eames, synthetic

    maps = maps_in([options.lights]) if options.lights else []
    if out.exists() and any(out.iterdir()) and not (out / "dataset.yaml").is_file():
        fault = "this folder is neither empty nor a data set"
        raise InputError(fault, file=out, cure="name an empty folder, or a data set to replace")
    rmtree(fresh, ignore_errors=True)

    def report(done: float, total: float, text: str) -> None:
        """Print the progress."""
        print(f"{out}: {done / total:4.0%} {text}", file=sys.stderr)

    if options.set == "eames":
        chairs = eames.ChairSetOptions(exact=options.exact, painted=options.painted)
        eames.generate(fresh, options.seed, maps, chairs, report)
    else:
        synthetic.generate(fresh, options.seed, maps, synthetic.SyntheticOptions(), report)
    sync_tree(fresh)


if __name__ == "__main__":
    main()
