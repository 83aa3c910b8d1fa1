"""Draw the README's figure of results from the tables of RESULTS.md, which name their commands and seeds.

python docs/images/results.py
"""

import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
ARMS = {
    "both": "past actions and back-updating",
    "back-updating, own messages": "back-updating and its own messages",
}
COLOURS = ("#0072B2", "#D55E00")


def table(heading: str) -> list[list[str]]:
    """Rows of the first table under a heading of RESULTS.md, without its header."""
    text = (HERE.parents[1] / "RESULTS.md").read_text().split(f"\n{heading}\n", 1)[1]
    lines = text.partition("\n\n| ")[2].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def draw_recovery(axis: plt.Axes) -> None:
    """Share of the delay's cost that awareness wins back, by task, with its 95 % interval."""
    task, tasks = "", []
    for name, arm, *_, recovery in table("## delaybench"):
        task = name or task
        if arm not in ARMS or recovery == "-":
            continue
        tasks = tasks if task in tasks else [*tasks, task]
        number = [float(x) for x in NUMBER.findall(recovery)]
        place, low, high = [*ARMS].index(arm), number[0] - number[1], number[2] - number[0]
        label = ARMS[arm] if len(tasks) == 1 else None
        x = len(tasks) - 1 + 0.36 * (place - 0.5)
        axis.bar(x, number[0], 0.34, yerr=[[low], [high]], color=COLOURS[place], capsize=2, label=label)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_xticks(range(len(tasks)), tasks)
    axis.set_ylabel("recovery of the delay's cost")
    axis.set_title("the paper's delay, ten seeds", fontsize="medium")
    axis.set_ylim(-0.6, 1.4)
    axis.legend(frameon=False, fontsize="small", loc="upper right")


def draw_longer_delays(axis: plt.Axes) -> None:
    """Return of the undelayed policy in ``tracking``, flown under constant delays."""
    rows = table("### Longer delays")
    random = float(next(row for row in rows if row[0] == "random")[1])
    points = [[float(x) for x in row[:3]] for row in rows if row[0] != "random"]
    delay, naive, own = zip(*points, strict=True)
    axis.plot(delay, own, "o-", color=COLOURS[1], label="knows its own messages")
    axis.plot(delay, naive, "s-", color=COLOURS[0], label="knows what the server holds")
    axis.axhline(random, color="0.5", linestyle="--", linewidth=0.8, label="random")
    axis.set(xlabel="delay of every message [steps]", ylabel="return, tracking", ylim=(0, None))
    axis.set_title("one policy, longer delays, five seeds", fontsize="medium")
    axis.legend(frameon=False, fontsize="small", loc="center right")


if __name__ == "__main__":
    with plt.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
        figure, (left, right) = plt.subplots(1, 2, figsize=(7, 2.6))
        draw_recovery(left)
        draw_longer_delays(right)
        figure.tight_layout()
        figure.savefig(HERE / "results.png", dpi=140)
