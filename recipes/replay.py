"""Make one page that plays stored episodes side by side, in any browser and without a network.

    damian replay runs/FOLDER/episode_0.json
    damian replay undelayed/episode_0.json late/episode_0.json --out both.html

The page (replay.html, unless --out names another one) shows what is true and what the server believes on a
map and in space, the messages on their way, and charts; docs/episodes.md explains it. All episodes share one
time line. The same seed flown with and without a delay shows what the delay does.
"""

from collections.abc import Sequence
from pathlib import Path

from damian.common import checks
from damian.common.errors import InputError, RunError
from damian.common.text_files import one_line
from damian.show.episode import Episode
from damian.show.replay_page import MOST, save_page

from .shared.command_line import Parser, exits_with_one_line


def parse(words: Sequence[str] | None) -> tuple[list[Path], Path]:
    """The files of the episodes, and that of the page.

    Raises:
        InputError: an option is unknown, no episode is given, too many are, or the page is no HTML file.
    """
    parser = Parser("damian replay", description="Make one page that plays stored episodes side by side.")
    parser.add_argument("episodes", type=Path, nargs="+", metavar="EPISODE.json", help="files of damian fly")
    parser.add_argument("--out", type=Path, default=Path("replay.html"), help="the page")
    args = parser.parse_args(words)
    checks.in_range("EPISODE.json", len(args.episodes), 1, MOST)
    page = args.out.suffix.lower() in (".html", ".htm")  # else a forgotten name would cost an episode
    checks.require(page, "--out", args.out, "is no page: its name must end in .html")
    return args.episodes, args.out


def main(words: Sequence[str] | None = None) -> None:
    """Make the page; wrong input ends with one line on stderr and exit code 2."""
    with exits_with_one_line():
        files, out = parse(words)
        episodes = [Episode.load(file) for file in files]
        try:
            save_page(episodes, out)
        except (RunError, ValueError) as error:
            raise InputError(f"--out: {error}") from None
    print(one_line(f"page: {out} ({out.stat().st_size / 1e6:.2g} MB)"))


def run() -> None:
    """Run the program with the words of the command line."""
    main()


if __name__ == "__main__":
    run()
