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
