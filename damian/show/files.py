"""Writes an episode as what people look at: film, figure and page."""

from collections.abc import Sequence
from pathlib import Path

from damian.show.episode import Episode
from damian.show.film import save_film, save_picture
from damian.show.replay_page import save_page


def save_episode(
    episode: Episode, file: Path, formats: Sequence[str], shown: Sequence[str]
) -> None:
    """Write an episode to ``file`` with the end ``.json``, and beside it all formats.

    Pictures and films tell the UAVs that are ``shown`` from the others.
    """
    episode.save(file.with_suffix(".json"))
    if "png" in formats:
        save_picture(episode, file.with_suffix(".png"), shown)
    if "html" in formats:
        save_page([episode], file.with_suffix(".html"))
    if "gif" in formats:
        save_film(episode, file.with_suffix(".gif"), shown)


def summary(name: str, episode: Episode) -> str:
    """One line about an episode."""
    n_sent = max(int(episode.sent.sum()), 1)
    age = episode.age[min(episode.n_steps, 1) :]  # of the steps, without the reset
    return (
        f"{name}: {episode.n_steps} steps, perceived return {episode.perceived_return:.2f}"
        f"{', success' if episode.success else ''}; mean age {age.mean():.2f} s, "
        f"messages late {episode.late.sum() / n_sent:.1%}, lost {episode.lost.sum() / n_sent:.1%}"
    )
