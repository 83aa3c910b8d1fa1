"""What becomes of the workers of a comparison that was killed."""

import subprocess
import sys
import time
from collections.abc import Callable

import pytest
from stopped_runs import is_locked


@pytest.mark.slow
def test_a_worker_ends_with_a_comparison_that_was_killed(tmp_path):
    run = f"""import time
from pathlib import Path
from damian.recipes.shared.many_runs import Run, perform_all
from damian.settings import TrainConfig

def wait(config, folder):
    (folder / "begun").touch()
    time.sleep(600)

if __name__ == "__main__":
    perform_all([Run("t", "d", "a", TrainConfig(), Path({str(tmp_path / "run")!r}), wait)], 2, ("", ""))
"""
    (tmp_path / "waits.py").write_text(run)
    process = subprocess.Popen([sys.executable, tmp_path / "waits.py"])
    try:
        until((tmp_path / "run" / "begun").exists)
        assert is_locked(tmp_path / "run")
    finally:
        process.kill()
        process.wait()
    until(lambda: not is_locked(tmp_path / "run"))


def until(true: Callable[[], bool]) -> None:
    """Wait until something is true."""
    end = time.monotonic() + 300
    while not true():
        assert time.monotonic() < end
        time.sleep(0.1)
