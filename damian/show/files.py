"""Writes an episode as what people look at: film, figure and page."""

from collections.abc import Collection, Sequence
from pathlib import Path

from matplotlib.animation import FFMpegWriter

from damian.common import checks
from damian.show.episode import Episode
from damian.show.film import save_film, save_picture
from damian.show.replay_page import save_page


def check_films(formats: Collection[str]) -> None:
    """Refuse a film that no program here can write."""
    films = "mp4" not in formats or FFMpegWriter.isAvailable()
    checks.require(
        films, "formats", "mp4", "needs the program ffmpeg, which is not there; choose gif"
    )


def save_episode(
    episode: Episode, file: Path, formats: Sequence[str], shown: Sequence[str]
) -> None:
    """Write an episode to ``file`` with the end ``.json``, and beside it all formats.

    Pictures and films (gif, mp4) tell the UAVs that are ``shown`` from the others.
    """
    episode.save(file.with_suffix(".json"))
    if "png" in formats:
        save_picture(episode, file.with_suffix(".png"), shown)
    if "html" in formats:
        save_page([episode], file.with_suffix(".html"))
    for kind in ("gif", "mp4"):
        if kind in formats:
            save_film(episode, file.with_suffix(f".{kind}"), shown)


def summary(name: str, episode: Episode) -> str:
    """One line about an episode."""
    n_sent = max(int(episode.sent.sum()), 1)
    age = episode.age[min(episode.n_steps, 1) :]  # of the steps, without the reset
    return (
        f"{name}: {episode.n_steps} steps, perceived return {episode.perceived_return:.2f}"
        f"{', success' if episode.success else ''}; mean age {age.mean():.2f} s, "
        f"messages late {episode.late.sum() / n_sent:.1%}, lost {episode.lost.sum() / n_sent:.1%}"
    )
