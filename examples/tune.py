"""Search for better settings of a learner with Optuna; the same command continues the search.

    pip install optuna    (the extra tune)
    python examples/tune.py 30 scenario=delaybench/tracking delay=paper aware=belief

Each trial is a training of its own, in runs/tune. All have the same seed: what they find must be
shown with other seeds.
"""

import subprocess
import sys
from pathlib import Path

import optuna

import damian

FOLDER = Path("runs/tune")


def objective(trial: optuna.Trial) -> float:
    """Train with settings that Optuna draws; returns the true return of the policy, its actions
    drawn."""
    drawn = {
        "learner.lr": trial.suggest_float("learner.lr", 1e-4, 1e-2, log=True),
        "learner.entropy_coeff": trial.suggest_float("learner.entropy_coeff", 1e-4, 0.1, log=True),
        "learner.gamma": trial.suggest_categorical("learner.gamma", [0.8, 0.9, 0.95, 0.98, 0.99]),
        "model.hidden": trial.suggest_categorical(
            "model.hidden", ["[64,64]", "[128,128]", "[256,256]"]
        ),
    }
    words = [*sys.argv[2:], *(f"{key}={value}" for key, value in drawn.items())]
    run = FOLDER / f"trial_{trial.number}"
    subprocess.run(["damian", "train", *words, f"hydra.run.dir={run}"], check=True)
    return damian.results(run).set_index("policy").at["trained", "return"]


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    storage = f"sqlite:///{FOLDER}/search.db"
    study = optuna.create_study(
        storage=storage, study_name="tune", direction="maximize", load_if_exists=True
    )
    # A training that is refused or diverges is a failed trial.
    study.optimize(
        objective, int(sys.argv[1]) - len(study.trials), catch=subprocess.CalledProcessError
    )
    print(f"best return {study.best_value:.4g}: {study.best_params}")
