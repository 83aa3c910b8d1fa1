"""Draws the figures of docs/concepts.md, what a delay is and what the laws do, and one of delaybench.

python docs/figures.py    (make pictures)
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torchrl.envs import GymEnv, TransformedEnv

from damian import Burst, Constant, Geometric, Lag, ObservationDelay, Uniform, set_seed
from damian.compare.comparison import TRAINED, Comparison
from damian.compare.figures import draw_groups, save, style_of
from damian.recipes import cli
from damian.recipes.compare import includes
from damian.recipes.shared.comparison_runs import stored_results

IMAGES = Path(__file__).parent / "images"
DELAYBENCH = Path(__file__).parent / "results" / "delaybench"
STEPS = 24
LAWS = {
    "constant: 3": Constant(3),
    "the paper's: 15 % take 4 to 7 steps": Uniform(4, 7, probability=0.15),
    "uniform: 1 to 7": Uniform(1, 7),
    "geometric: 2 in the mean": Geometric(2),
    "burst: at times 6 steps, half of them lost": Burst(enter=0.05, leave=0.2, bad=6, bad_loss=0.5),
    "lag: for 20 steps the same, 0 to 6": Lag(Uniform(0, 6), update_period=20),
}
_DELAY, _FLOWN = "@delay_", 4
"""Mark of the tasks of held-out delays; least number of them under which a policy flew, to be drawn."""
_SPECIALISTS = ", trained at each delay"
"""End of the label of a line of policies that fly under the delay at which they were trained."""
SHOWN = ["experiment=delaybench", "tasks=[crowded]", "delays=['4','5',lag,0-7]"]
SHOWN += ["arms=[undelayed,backupdate+gru,timeline,timeline+gru]"]
"""What the figure of delaybench shows."""
BLUE, ORANGE, GREY = "tab:blue", "tab:orange", "0.6"


class Drawn(NamedTuple):
    """Messages of consecutive steps, from step 1 on."""

    delay: np.ndarray
    """Delay of the message of each step [steps], -1 if it is lost, [T]."""
    age: np.ndarray
    """Age of the message that the receiver holds [steps], [T]."""


def draw_messages(law: Any, n_steps: int, seed: int, loss: float = 0.0) -> Drawn:
    """Let a law delay the observations of an environment."""
    env = TransformedEnv(GymEnv("Pendulum-v1"), ObservationDelay(law, loss=loss, delay_key="delay"))
    set_seed(env, seed)
    torch.manual_seed(seed)
    steps = env.rollout(n_steps)["next"]
    return Drawn(steps["delay"].flatten().numpy(), steps["age"].flatten().numpy())


def age_in_hindsight(delay: np.ndarray) -> np.ndarray:
    """Age of the newest message of each step or of an earlier one that ever arrives, [T]; step 0 is known."""
    steps = np.arange(1, len(delay) + 1)
    return steps - np.maximum.accumulate(np.where(delay >= 0, steps, 0))


def plot_model(axes: tuple[Axes, Axes], drawn: Drawn) -> None:
    """Draw each message from when it is sent until it arrives, and the ages of what is known."""
    ways, ages = axes
    for step, delay in enumerate(drawn.delay, 1):
        if delay < 0:
            ways.plot(step, 1, "x", color=ORANGE)
            continue
        ways.plot([step, step + delay], [1, 0], "-", color=BLUE if delay else GREY, lw=1)
        ways.plot([step], [1], "o", color=BLUE, ms=3)
        ways.plot([step + delay], [0], "v", color=BLUE, ms=4)
    ways.set_yticks([0, 1], ["arrives", "sent"])
    ways.set_title("Messages: each line is one on its way, crosses are lost", loc="left", fontsize=9)
    steps = np.arange(1, len(drawn.age) + 1)
    ages.step(steps, drawn.age, where="mid", color=BLUE, label="the server, when it acts")
    hindsight = age_in_hindsight(drawn.delay)
    ages.step(steps, hindsight, where="mid", color=ORANGE, label="back-updating, once all have arrived")
    ages.set(xlabel="step", ylabel="age [steps]", xlim=(0.5, len(steps) + 0.5), ylim=(-0.4, 9))
    ages.set_title("Age of the newest message that is known of a step", loc="left", fontsize=9)
    ages.legend(fontsize=8, frameon=False, loc="upper left")


def main() -> None:
    """Draw and write the figures."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    plot_model((axes[0], axes[1]), draw_messages(Uniform(1, 7, probability=0.6), STEPS, seed=3, loss=0.12))
    figure.savefig(IMAGES / "delay_model.png", dpi=110)
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    for panel, (name, law) in zip(panels.flat, LAWS.items(), strict=True):
        age = draw_messages(law, 100, seed=0).age
        panel.step(np.arange(1, len(age) + 1), age, where="mid", color=BLUE, lw=1)
        panel.set_title(f"{name}\nmean age {age.mean():.1f}", fontsize=8, loc="left")
    for panel in panels[:, 0]:
        panel.set_ylabel("age [steps]", fontsize=8)
    for panel in panels[-1]:
        panel.set_xlabel("step", fontsize=8)
    figure.savefig(IMAGES / "delay_laws.png", dpi=110)
    plot_matrix(DELAYBENCH / "matrix.png")


def plot_matrix(path: Path) -> None:
    """Draw delaybench: scores over the held-out delays under which policies flew, a line for each training.

    Held-out tasks of delays have names that begin with ``delay_``; a policy must have flown under four.
    Dashed, an arm that was trained at several constant delays: at each one, the policies trained there.
    """
    config = cli.settings(*SHOWN, program="compare")
    results = stored_results(path.parent).only(partial(includes, config))
    comparison = Comparison(*results, config.chosen("arms"))
    drawn = {task: lines for task in comparison.tasks() if len(lines := _matrix(comparison, task))}

    def panel(axis: Axes, task: str) -> None:
        names = sorted(drawn[task]["flown"].unique(), key=lambda x: (not x.isdecimal(), x.zfill(9)))
        styles = {label: style_of(n) for n, label in enumerate(drawn[task]["label"].unique())}
        for label, style in styles.items():
            style["linestyle"] = "--" if label.endswith(_SPECIALISTS) else "-"
        draw_groups(axis, drawn[task], ("flown", "label", comparison.score), names, styles)
        axis.tick_params(axis="x", rotation=90)
        axis.set(title=task, xlabel="delay of the flight [steps], or its law", ylabel=comparison.score)

    save(path, [*drawn], panel, (6.4, 3.6))


def _matrix(comparison: Comparison, task: str) -> pd.DataFrame:
    """Lines of the table with the delay in which they were ``flown``, and a ``label`` for each training."""
    table = comparison.table[comparison.table["policy"] == TRAINED]
    away = table[table["task"].str.startswith(f"{task}{_DELAY}")]
    flown, label = (
        away["task"].str.removeprefix(f"{task}{_DELAY}"),
        away["arm"] + ", trained at " + away["delay"],
    )
    away = away.assign(flown=flown, label=label)
    away = away[away.groupby("label")["flown"].transform("size") >= _FLOWN]
    constant = [name for name in flown.unique() if name.isdecimal()]
    trained = [name for name, arm in comparison.arms.items() if arm.policy_of is None]
    own = table[(table["task"] == task) & table["delay"].isin(constant) & table["arm"].isin(trained)]
    own = own.assign(flown=own["delay"], label=own["arm"] + _SPECIALISTS)
    own = own[own.groupby("label")["flown"].transform("size") > 1]
    return pd.concat([away, own]) if len(away) else away


if __name__ == "__main__":
    main()
