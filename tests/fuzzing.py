"""Bad input for the programs, made from their settings, and what must be true of the answer to it.

The settings, their types and their defaults are read from the schema, so that a new one is tried as well.
"""

import functools
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from damian import keys
from damian.common import text_files
from damian.common.errors import InputError
from damian.delays.laws import LAWS
from damian.envs.pipeline import make_env
from damian.keys import next_key
from damian.recipes.shared.command_line import prepared
from damian.recipes.shared.composition_errors import COMPOSITION_ERRORS, foreign_cause, one_line
from damian.recipes.shared.known_settings import CONF, default_options, groups, known_settings
from damian.recipes.shared.launch import checked
from damian.recipes.shared.settings import TrainConfig
from damian.world.regions import polygon

SMALL = (
    "region=vertices",
    "region.vertices=[[0,0],[300,0],[300,300],[0,300]]",
    "region.lattice_step=100",
    "region.initial_conditions=4",
    "actions.distances=[0,100]",
    "actions.headings=[0,90]",
)
"""A region with few landing points, so that an environment is built in some hundredths of a second."""
LONGEST_LINE = 1200
"""Characters of the longest error."""

_NUMBERS = """nan inf -inf -1 0 -0.0 1 2 3 5 0.5 3.5 10 64 100 1000 1e-300 1e-9 1e300 1e20 1e9 1e6 1e5 -3
    2147483648 4294967296 9223372036854775808 0x10 1_000 +5 1e400 .5 5. 00 1e -"""
NUMBERS = _NUMBERS.split()
_TIMES = "0s 1s 2s 3s 0.5s -3s 1e9s 1e300s nans infs 0.5m 1h 3ms 3S s 1e-9s 1d 1_0s 3ss ٣s"
TIMES = _TIMES.split()
WORDS = [
    *["null", "true", "false", "yes", "''", '""', "none", "~", "???", "$", "\\", "%", "#", "@", "=", "a=b"],
    *["${agents}", "${agents", "${x.y}", "${oc.env:NO_SUCH_NAME}", "${seed:}", "${now:%Y}", "${..agents}"],
    *["a:b", "os:nothing", ":", "a.b:", ":b", "json:dumps", "os.path", "../../x", "/", "/dev/null", "."],
    *[
        "é",
        "☃",
        "\u202e",
        "\t",
        " ",
        "a b",
        "\x1b[31m",
        "a\nb",
        "\x7f",
        "\udc80",
        "\ufeff",
        "x" * 5000,
        "9" * 5000,
    ],
    *["[", "]", "{", "}", "[]", "{}", "[[]]", "[,]", "[1,2", "{a:1}", "{a: b: c}", "(1)", "1,2", "range(3)"],
    *[
        "choice(1,2)",
        "glob(*)",
        "sort(2,1)",
        "int(x)",
        "float(nan)",
        "'",
        '"',
        "'a",
        "\"a'",
        "!!python/x",
        "&a",
        "*a",
    ],
]


def quoted(text: str) -> str:
    """A value as one quoted string of Hydra."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


WORDS += ["[" * 3000, "[" * 500 + "]" * 500, "{a: " * 500 + "1" + "}" * 500]


@functools.cache
def scalars() -> st.SearchStrategy[str]:
    """Numbers, times, words and text of every kind."""
    text = st.text(max_size=12)
    number = st.one_of(st.integers(-(10**12), 10**12), st.floats()).map(str)
    return st.one_of(
        *(st.sampled_from(each) for each in (NUMBERS, TIMES, WORDS)), number, text, text.map(quoted)
    )


@functools.cache
def nested() -> st.SearchStrategy[str]:
    """Lists and mappings of scalars, some of them inside each other."""

    def deeper(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
        pair = st.tuples(st.sampled_from(["a", "law", "path", "term", "sensor", "1", "name"]), inner)
        lists = st.lists(inner, max_size=3).map(lambda each: f"[{','.join(each)}]")
        mappings = st.lists(pair.map(": ".join), max_size=3).map(lambda each: "{" + ", ".join(each) + "}")
        return st.one_of(lists, mappings)

    leaf = st.one_of(st.sampled_from([*NUMBERS, *TIMES, "null", "true", "''", "a"]))
    return st.recursive(leaf, deeper, max_leaves=6)


@functools.cache
def laws() -> st.SearchStrategy[str]:
    """Delay laws with parameters of their own, or of others."""
    names = sorted({field.name for law in LAWS for field in fields(LAWS.get(law, "law"))})
    value = st.sampled_from([*NUMBERS, *TIMES, "true", "episode", "nowhere.csv"])

    def law(name: str) -> st.SearchStrategy[str]:
        own = [field.name for field in fields(LAWS.get(name, "law"))]
        pairs = st.dictionaries(st.sampled_from(own * 3 + names), value, max_size=3)
        return pairs.map(
            lambda p: "{" + ", ".join([f"law: {name}", *(f"{k}: {v}" for k, v in p.items())]) + "}"
        )

    return st.sampled_from(list(LAWS)).flatmap(law)


@functools.cache
def near(default: str) -> list[str]:
    """Numbers around a default one, so that accepted ones occur too."""
    try:
        value = float(default)
    except ValueError:
        return [default] if default.isidentifier() else []
    whole = "." not in default
    scaled = [value * scale for scale in (0, 0.5, 1, 2, 10, 1e3, 1e8, -1)]
    return [str(int(each) if whole else each) for each in scaled] + [default] * 2


@functools.cache
def settings_of(program: str) -> dict[str, Any]:
    """Every setting of a program by its dotted key; in a section of names, one is called ``a``."""
    return {key.replace("NAME", "a"): setting for key, setting in known_settings(program).items()}


@functools.cache
def values(program: str, key: str) -> st.SearchStrategy[str]:
    """Values for a setting: near its default, of its type, or of another one."""
    setting = settings_of(program)[key]
    kinds = [scalars(), nested()]
    if setting.kind.startswith(("int", "float")):
        kinds += [st.sampled_from(NUMBERS), st.floats().map(str)]
    if "str" in setting.kind:
        kinds += [st.sampled_from(TIMES)]
    if setting.kind == "bool":
        kinds += [st.sampled_from(["true", "false"])] * 4
    if close := near(setting.default):
        kinds += [st.sampled_from(close)] * 4
    if "list" in setting.kind:
        kinds.append(st.lists(scalars(), max_size=4).map(lambda each: f"[{','.join(each)}]"))
    if setting.kind == "Any":
        kinds += [laws()] * 2
    return st.one_of(kinds)


@st.composite
def word(draw: Any, program: str) -> str:
    """One word of a command line."""
    kind = draw(st.integers(0, 19))
    if kind == 0:
        return draw(st.text(max_size=15)) or "="
    if kind == 1:
        group = draw(st.sampled_from([*default_options(program), *groups()]))
        return f"{group}={draw(st.one_of(st.sampled_from(groups().get(group, ['none'])), scalars()))}"
    key = draw(st.sampled_from([*settings_of(program)]))
    close = near(settings_of(program)[key].default)
    value = draw(st.sampled_from(close) if close and kind > 13 else values(program, key))
    if kind == 2:
        cut = draw(st.integers(0, len(key) - 1))
        key = draw(
            st.sampled_from([key[:cut] + key[cut + 1 :], f"{key}.x", f"x.{key}", key.upper(), f"{key}[0]"])
        )
    if kind in (3, 4):
        return f"{draw(st.sampled_from(['+', '++', '~', '+++', '@']))}{key}={value}"
    return f"{key}={value}"


def words(program: str, most: int = 3) -> st.SearchStrategy[list[str]]:
    """A command line: most of its words set a setting of the program, to a sensible value or not."""
    return st.lists(word(program), min_size=1, max_size=most)


_groups = functools.cache(groups)


@functools.cache
def _base(program: str, given: tuple[str, ...]) -> bytes:
    with initialize_config_dir(CONF, version_base=None):
        return pickle.dumps(compose(program, list(given)))  # read again faster than it is copied


def composed(program: str, given: list[str], small: tuple[str, ...] = SMALL) -> DictConfig:
    """What Hydra composes; without words that choose an option of a group, by its second step alone.

    Composing all files takes a tenth of a second, and setting keys a few milliseconds.
    """
    given = [each for each in prepared(given) if not each.startswith("-")]
    overrides = OverridesParser.create().parse_overrides(given)
    if any(each.key_or_group.startswith("hydra") or each.key_or_group in _groups() for each in overrides):
        with initialize_config_dir(CONF, version_base=None):
            return compose(program, given)
    config = pickle.loads(_base(program, small))
    ConfigLoaderImpl._apply_overrides_to_config(overrides, config)
    return config


def refusal(given: list[str], act: Callable[[list[str]], None], program: str = "train") -> str | None:
    """The one line that refuses some words, as ``launch`` would print it; None if they are accepted.

    Any other exception passes: it would be a traceback.
    """
    sys.argv[1:] = given
    try:
        act(given)
    except COMPOSITION_ERRORS as error:
        if not isinstance(error, InputError | OmegaConfBaseException) and _after_composition(error):
            raise
        line, cause = one_line(error, program), foreign_cause(error)
    else:
        return None
    check_line(line, given, program)
    assert cause is None or ":" in "".join(given), f"{line} (an exception of ours: {cause!r})"
    return line


def _after_composition(error: BaseException) -> bool:
    frame, names = error.__traceback__, set()
    while frame is not None:
        names.add(frame.tb_frame.f_code.co_name)
        frame = frame.tb_next
    return "composed" not in names


def check_line(line: str, given: list[str], program: str = "train") -> None:
    """An error is one line, printable, not long, and says which key, file or word is meant."""
    assert 0 < len(line.strip()) <= LONGEST_LINE, f"{len(line)} characters: {line[:200]}"
    assert line.isprintable(), repr(line)
    known = {part for key in settings_of(program) for part in (key, key.rpartition(".")[2])}
    typed = {each.partition("=")[0].lstrip("+~") for each in given}
    typed |= {text_files.one_line(key) for key in typed}
    typed |= {key.partition(".")[0] for key in typed} | {repr(each) for each in given}
    meant = {*known, *default_options("train"), *_groups(), *typed, "nested too deeply", "lattice step"} - {
        ""
    }
    files = tuple(each.partition("=")[2] for each in given if each.partition("=")[2])
    assert any(name in line for name in meant) or line.startswith(files), line


@contextmanager
def small_limits() -> Iterator[None]:
    """Refuse as too large what would take seconds to build, instead of what takes minutes."""
    before = polygon.MAX_CANDIDATES
    polygon.MAX_CANDIDATES = 20_000
    try:
        yield
    finally:
        polygon.MAX_CANDIDATES = before


def is_affordable(config: TrainConfig) -> bool:
    """Whether an environment of these settings is built and stepped in a fraction of a second."""
    region, source = config.region, config.source
    stops = source.n_hotspots * (source.max_stops + 1) if source.motion == "dynamic" else 1
    few = config.agents <= 8 and region.pool <= 4 and region.initial_conditions * stops <= 20_000
    short = not config.clock.skip or (config.episode.max_steps or 10**9) <= 100
    return few and short and config.longest_delay <= 1000


def fly(given: list[str]) -> None:
    """Compose, check, and, if that is cheap enough, build two worlds and step them with finite numbers."""
    config: TrainConfig = checked(composed("train", given))
    config.check_learning()
    if not is_affordable(config):
        return
    with small_limits():
        env = make_env(config.train_scenario, 2, config.seed, "cpu", ["reward_terms"])
    with torch.no_grad():
        rollout = env.rollout(3, break_when_any_done=False)
    for key in (keys.OBSERVATION, keys.GLOBAL_OBSERVATION, next_key(keys.REWARD)):
        assert rollout[key].isfinite().all(), (key, given)


def examples(quick: int, deep: int) -> settings:
    """How many examples a test tries in ``make test``, and in ``make test-deep``."""
    is_deep = settings().max_examples > 100
    return settings(max_examples=deep if is_deep else quick, suppress_health_check=list(HealthCheck))
