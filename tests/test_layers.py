"""The layers of the code: who may import whom, and that a run with nothing to do loads no science."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_the_contracts_of_pyproject_hold():
    lint = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", lint], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-2000:]


def test_the_command_line_loads_no_science():
    code = (
        "import sys, factorlib.__main__; from factorlib.runner.project import photo_sets; photo_sets(); from factorlib.runner import survey\n"
        "heavy = {'numpy', 'torch', 'scipy', 'OpenImageIO', 'rich', 'filelock', 'typer', 'pydantic'} & set(sys.modules); sys.exit(', '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_stage_of_the_pipeline_has_its_module_and_the_runner_finds_what_it_imports():
    from factorlib.runner.closure import Sources
    from factorlib.runner.filehash import FileHashes
    from factorlib.runner.pipeline import read_pipeline
    from factorlib.runner.project import photo_sets

    pipeline = read_pipeline(ROOT / "pipeline.yaml", photo_sets().slices)
    sources = Sources([ROOT], FileHashes(None))
    for name in pipeline.stages:
        closure = sources.closure("stages", name, ROOT / "pipeline.yaml")
        assert {f"source:stages.{name}", "source:factorlib.stage"} <= closure.record.keys()
        assert not any(name.startswith("source:factorlib.runner") for name in closure.record)
