"""Builds the documentation site for tests."""

import os
import subprocess
import sys
from pathlib import Path

import damian

ROOT = Path(damian.__file__).parents[1]


def build(folder: Path) -> Path:
    """The site, built in this folder without a warning."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder
