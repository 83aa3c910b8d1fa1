"""Draws the figures of docs/concepts.md (delays and their laws), of docs/world.md, and one of
delaybench.

python docs/figures.py    (make pictures)
"""

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch
from leaderboard_pages import FEWEST
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from torchrl.envs import GymEnv, TransformedEnv

from damian import Burst, Constant, Geometric, Lag, ObservationDelay, Uniform, set_seed
from damian.baselines.script import script_policy
from damian.common.plotting import COLOURS, STYLE
from damian.compare.comparison import (
    ENDS,
    NOT_LATE,
    TRAINED,
    Comparison,
)
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS
from damian.recipes import cli
from damian.recipes.compare import includes
from damian.recipes.shared.environments import compose_scenario
from damian.recipes.shared.sweeps import stored_results
from damian.runs.run_folder import PLANNER, RANDOM, SCRIPT
from damian.show.episode import record
from damian.show.frame import frame_of
from damian.show.views import MapView, legend_marks

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
SHOWN = ["experiment=delaybench", "tasks=[crowded]", "delays=['1','2','3','4','5','6',lag]"]
SHOWN += ["methods=[undelayed,backupdate+gru,timeline,timeline+gru]"]
"""What the figure of delaybench shows."""
ALONE = "backupdate+gru"
POLICIES = {
    ("timeline+gru", "lag"): "one policy: timeline, GRU, back-updating (trained at 1 to 7)",
    ("timeline", "lag"): "the same without GRU",
    (ALONE, "lag"): "without timeline (trained at 1 to 7)",
    (ALONE, "4"): "without timeline (trained at 4)",
}
"""Labels of the trainings in the figure: method, and delay of the training
(lag: one to seven steps)."""
LAWS_FLOWN = {
    "1-7": "1 to 7",
    "lost": "1 to 7, a\nfifth lost",
    "bimodal": "1 or 6",
    "burst": "bursts",
    "paper": "the\npaper's",
    "trace": "measured\nlink",
}
"""Labels of the laws that are no constant delay."""
SEARCH = ["scenario=search_and_rescue", "source.count=3", "region.zones=0"]
BELIEF = [*SEARCH, "source.miss=0", "source.false_alarm=0", "observation.belief=[belief_moments]"]
RANDOMISED = "randomise={source.level_db: [134, 138, 142], wind.speed: [0, 8]}"
WORLDS = {
    "all": ([*SEARCH[:2], "motion.max_speed=[10,15,20]", "wind.speed=4", "delay=paper"], 39),
    "several_sources": (BELIEF, 60),
    "unequal_uavs": (["scenario=convoy", "motion.max_speed=[5,15,25]", "region=random"], 10),
    "zones": (["scenario=patrol", "wind.speed=0", "wind.gusts=0", "region.zones=8"], 25),
    "wind": (["scenario=patrol", "wind.speed=6", "wind.direction=270", "wind.gusts=2"], 20),
    "detection": ([*SEARCH, "source.miss=0.3", "source.false_alarm=0.1"], 40),
    "randomisation": ([*SEARCH, RANDOMISED], 20),
    "requests": (["scenario=requests"], 20),
}
"""Pictures of docs/world.md: what is flown by the script, and the step that is shown."""
TASKS = {
    "crowded ground": ("delaybench", "crowded"),
    "two UAVs": ("delaybench", "crowded_pair"),
    "with flights": ("delaybench", "crowded_flights"),
    "flights that end\nelsewhere (news)": ("delaybench", "crowded_news"),
    "one moving\nsource (news)": ("delaybench", "tracking"),
    "two moving\nsources (news)": ("tasks", "convoy"),
}
"""Tasks of the figure that tells who wins where: where their rows are stored, and their names."""
WINNERS = {
    "newest messages": ("naive+gru", "naive"),
    "newest messages, back-updating": ("backupdate+gru", "backupdate"),
    "the same, jitter buffer": ("backupdate+gru+hold",),
    "timeline, back-updating": ("timeline",),
    "the same, memory": ("timeline+gru",),
    "a filter that forecasts the others": ("forecast+filter",),
    "a Bayes filter of the source": ("belief",),
    "script, flown forward": ("script+forward",),
    "planner": ("planner",),
}
"""Labels of methods in that figure; of several the first is shown that has been run."""
SCRIPTED = {"script+forward": SCRIPT, "planner": PLANNER}
"""Policies of methods that train none."""
UNDELAYED = "undelayed"
LOOKS = [*((colour, "o") for colour in COLOURS), *(("0.3", marker) for marker in "os^")]
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
    """Age of the newest message of each step or of an earlier one that ever arrives, [T]; step 0 is
    known."""
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
    ways.set_title(
        "Messages: each line is one on its way, crosses are lost", loc="left", fontsize=9
    )
    steps = np.arange(1, len(drawn.age) + 1)
    ages.step(steps, drawn.age, where="mid", color=BLUE, label="the server, when it acts")
    hindsight = age_in_hindsight(drawn.delay)
    ages.step(
        steps, hindsight, where="mid", color=ORANGE, label="back-updating, once all have arrived"
    )
    ages.set(xlabel="step", ylabel="age [steps]", xlim=(0.5, len(steps) + 0.5), ylim=(-0.4, 9))
    ages.set_title("Age of the newest message that is known of a step", loc="left", fontsize=9)
    ages.legend(fontsize=8, frameon=False, loc="upper left")


def main() -> None:
    """Draw and write the figures."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    plot_model(
        (axes[0], axes[1]), draw_messages(Uniform(1, 7, probability=0.6), STEPS, seed=3, loss=0.12)
    )
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
    plot_tasks(IMAGES / "tasks.png")
    for name, (words, step) in WORLDS.items():
        plot_world(IMAGES / f"world_{name}.png", words, step, 1 + (name == "randomisation"))


def plot_world(path: Path, words: list[str], step: int, worlds: int) -> None:
    """Draw an instant of an episode that the script flies, of several worlds beside each other."""
    env = make_env(compose_scenario(*words), worlds, seed=2, extras=EXTRAS)
    torch.manual_seed(0)
    rollout = env.rollout(step + 1, script_policy(env), break_when_any_done=False)
    with matplotlib.rc_context({**STYLE, "font.size": 8}):
        figure = Figure(figsize=(2.2 + 3.2 * worlds, 3.2), layout="constrained")
        axes = np.atleast_1d(figure.subplots(1, worlds))
        for axis, episode in zip(axes, record(rollout, env.uav_env, {}), strict=True):
            MapView(axis, episode).draw(frame_of(episode, min(step, episode.n_steps)))
            wind = episode.about.get("wind")
            if worlds > 1 and wind:
                axis.set_title(
                    f"{episode.radius:.0f} m around a UAV, wind {wind[0]:.1f} m/s", loc="left"
                )
        figure.legend(handles=legend_marks(episode), loc="outside right upper", frameon=False)
        figure.savefig(path, dpi=110)
    Image.open(path).convert("RGB").quantize(dither=Image.Dither.NONE).save(path, optimize=True)


def plot_matrix(path: Path) -> None:
    """Draw delaybench: returns over the delay of the flight, a line for each training."""
    config = cli.settings(*SHOWN, program="compare")
    results = (rows[includes(config, rows)] for rows in stored_results(path.parent))
    table = Comparison(*results, config.experiment.methods).table
    rows = table.set_index(["method", "delay", "task", "policy"])[["return" + end for end in ENDS]]
    constant = [str(steps) for steps in range(9)]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=(9, 7))
        for number, (trained, label) in enumerate(POLICIES.items()):
            look = {"color": COLOURS[number], "linewidth": 1.2 + (number == 0), "markersize": 4}
            for axis, flown in ((left, constant), (right, [*LAWS_FLOWN])):
                tasks = {
                    name: "crowded" if name == trained[1] else f"crowded@delay_{name}"
                    for name in flown
                }
                known = {
                    place: rows.loc[key]
                    for place, name in enumerate(flown)
                    if (key := (*trained, tasks[name], TRAINED)) in rows.index
                }
                value, low, high = np.array([*known.values()]).reshape(-1, 3).T
                error = np.nan_to_num([value - low, high - value], posinf=0)
                line = "-" if axis is left else ""
                place = np.array([*known]) + (axis is right) * 0.12 * (number - 1)
                axis.errorbar(place, value, error, marker="o", linestyle=line, label=label, **look)
        there = {
            x: rows.loc[key]
            for x in range(9)
            if (key := (ALONE, str(x), "crowded", TRAINED)) in rows.index
        }
        label = "without timeline (trained at the delay of the flight)"
        left.plot(
            [*there],
            [row["return"] for row in there.values()],
            "D",
            color="0.3",
            markersize=3,
            label=label,
        )
        for axis, labels in ((left, constant), (right, [*LAWS_FLOWN.values()])):
            axis.set_xticks(range(len(labels)), labels)
            for method, policy, line in (("undelayed", TRAINED, "--"), (RANDOM, RANDOM, ":")):
                level = rows.loc[method, "none", "crowded", policy]["return"]
                axis.axhline(level, color="0.5", linestyle=line, linewidth=0.8)
                right.annotate(method, (len(LAWS_FLOWN) - 1, level + 0.3), ha="right", color="0.4")
        left.set(xlabel="delay of every message [steps]", ylabel="return")
        right.set(xlabel="delays that vary")
        handles = left.get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=2, frameon=False)
        figure.savefig(path, dpi=150)


def plot_tasks(path: Path) -> None:
    """Draw who wins where: normalised returns under one to seven steps, a column for each task."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        axes = figure.subplots()
        for place, (folder, task) in enumerate(TASKS.values()):
            results = stored_results(DELAYBENCH.parent / folder)
            methods = cli.settings(f"experiment={folder}", program="compare").experiment.methods
            rows, points = (each[each["task"] == task] for each in results)
            rows = rows[rows["delay"].isin(("1-7", NOT_LATE))]
            seeds = rows.groupby("method")["seed"].nunique()
            for number, names in enumerate(WINNERS.values()):
                run = [name for name in names if seeds.get(name, 0) >= FEWEST]
                if run:
                    compared = rows[rows["method"].isin((UNDELAYED, run[0]))]
                    table = Comparison(compared, points, methods).table
                    policy = SCRIPTED.get(run[0], TRAINED)
                    (known,) = table.loc[
                        (table["method"] == run[0]) & (table["policy"] == policy)
                    ].to_dict("records")
                    value, low, high = (known["J_norm" + end] for end in ENDS)
                    x = place + 0.09 * (number - (len(WINNERS) - 1) / 2)
                    error = [[value - low], [high - value]]
                    colour, marker = LOOKS[number]
                    axes.errorbar(x, value, error, marker=marker, color=colour, markersize=4)
        for (colour, marker), label in zip(LOOKS, WINNERS, strict=True):
            axes.plot([], [], marker, color=colour, markersize=4, label=label)
        for level in (0, 1):
            axes.axhline(level, color="0.5", linewidth=0.8, linestyle="--" if level else ":")
        axes.set_xticks(range(len(TASKS)), TASKS)
        axes.set(ylabel="return (0 random, 1 undelayed)", xlim=(-0.6, len(TASKS) - 0.4))
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
        figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
