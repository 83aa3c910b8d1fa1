"""Files of a run folder: their names, the learning curve, and the table of results."""

import io
import math
from dataclasses import asdict, fields
from pathlib import Path

from damian.common.atomic_files import write_atomically
from damian.common.csv_table import csv_table
from damian.common.markdown import markdown_table
from damian.evaluation.metrics import Evaluation

FIGURE = "learning_curve.png"
CHECKPOINT = "checkpoint.pt"
BEST = "best.pt"
REPLAY = "replay"
CONFIG = "config.yaml"
RESULTS = "result.csv"
TABLE = "result.md"


def plot_learning_curve(rows: list[dict[str, float]], random: Evaluation, path: Path, title: str) -> None:
    """Draw return and success rate over environment steps, with the random policy as a dashed line."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import, needed once)
    from matplotlib.ticker import EngFormatter  # noqa: PLC0415

    panels = [("episode_return", "return", random.episode_return)]
    if any(row["success_rate"] > 0 for row in rows):
        panels.append(("success_rate", "success rate", random.success_rate))
    figure = Figure(figsize=(5 * len(panels), 3.4))
    axes = figure.subplots(1, len(panels), squeeze=False)
    for axis, (name, label, level) in zip(axes[0], panels, strict=True):
        points = [(row["frames"], row[name]) for row in rows if not math.isnan(row[name])]
        mark = "o" if len(points) == 1 else ""  # a line of one point would be invisible
        axis.plot(*zip(*points, strict=True), color="tab:blue", marker=mark, label="while training")
        axis.axhline(level, color="tab:gray", linestyle="--", label="random policy")
        axis.set_xlabel("environment steps, all worlds")
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0][0].legend(loc="best", fontsize="small")
    figure.suptitle(title, fontsize="medium")
    figure.tight_layout()
    image = io.BytesIO()
    figure.savefig(image, dpi=120)
    write_atomically(path, image.getvalue())


SEEN = """seen: as the server perceived it, else as it truly was; age: mean age of what the server holds
[steps]; late and lost: shares of the messages."""
"""Lines under a table of evaluations in which messages are delayed."""


def save_results(
    rows: dict[str, Evaluation], folder: Path, can_succeed: bool, late: bool, note: str = ""
) -> str:
    """Write evaluations by policy to ``result.csv`` and, as a Markdown table, to ``result.md``.

    Args:
        rows: evaluations by name of the policy.
        folder: the run folder.
        can_succeed: as for ``results_table``.
        late: as for ``results_table``.
        note: what stands under the table, before what its columns mean.

    Returns:
        the table, with what stands under it.
    """
    below = "\n".join(filter(None, [note, SEEN if late else ""]))
    table = results_table(rows, can_succeed, late) + (f"\n\n{below}" if below else "")
    write_atomically(folder / TABLE, table + "\n")
    head = ["policy", *(field.name for field in fields(Evaluation))]
    results = csv_table([head, *([name, *asdict(row).values()] for name, row in rows.items())])
    write_atomically(folder / RESULTS, results)  # last: with it, a run counts as finished
    return table


def results_table(rows: dict[str, Evaluation], can_succeed: bool, late: bool = False) -> str:
    """Evaluations of several policies as a Markdown table.

    Args:
        rows: evaluations by name of the policy.
        can_succeed: whether the task can succeed; if so, success rate and steps are shown.
        late: whether messages are delayed; if so, what the server has seen stands beside what has truly
            happened, with the age of information and the shares of late and lost messages.
    """
    success = {"success rate": "success_rate", "steps": "steps"} if can_succeed else {}
    columns = seen = success | {"return": "episode_return"}
    if late:
        columns = {title: f"true_{field}" for title, field in success.items()} | {"return": "true_return"}
        columns |= {f"seen {title}": field for title, field in seen.items()}
        columns |= {"age": "age", "late": "late", "lost": "lost"}
    columns |= {"episodes": "episodes"}
    lines = (
        [name, *(_number(getattr(row, field)) for field in columns.values())] for name, row in rows.items()
    )
    return markdown_table(["policy", *columns], lines)


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.2f}"
