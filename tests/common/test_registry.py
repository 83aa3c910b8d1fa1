"""Components are found by name or by path, and what cannot be found is said in one line."""

import pytest

from damian.common.errors import InputError
from damian.common.registry import Registry, check_parameters


def greetings() -> Registry:
    registry = Registry("greeting", problem=lambda found: None if callable(found) else "is no function")

    @registry.register("plain")
    def plain() -> str:
        return "hello"

    return registry


def test_a_registered_component_is_found_by_its_name():
    registry = greetings()
    assert registry.get("plain", "greeting")() == "hello"
    assert list(registry) == ["plain"]
    assert "plain" in registry
    assert dict(registry.items()).keys() == {"plain"}


def test_a_component_of_ones_own_is_found_by_its_path_in_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "polite_words.py").write_text("def formal():\n    return 'good day'\n")
    assert greetings().get("polite_words:formal", "greeting")() == "good day"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("rude", "greeting: rude is not one of plain, nor a path such as package.module:Name"),
        (3, "greeting: 3 is not one of plain"),
        (
            "nowhere_at_all:formal",
            "greeting: nowhere_at_all:formal: No module named 'nowhere_at_all'; nowhere_at_all must",
        ),
        ("math:formal", "greeting: math:formal: the module math has no formal"),
        ("math:pi", "greeting: math:pi is no function"),
    ],
)
def test_what_cannot_be_found_is_said_in_one_line(name, message):
    with pytest.raises(InputError) as error:
        greetings().get(name, "greeting")
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_a_module_that_fails_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken_words.py").write_text("1 / 0\n")
    with pytest.raises(InputError, match="importing it raised ZeroDivisionError: division by zero"):
        greetings().get("broken_words:formal", "greeting")


def polite(*, to: str, loud: bool = False) -> str:
    return f"good day, {to}"


def test_a_component_and_its_parameters_are_read_from_a_mapping():
    path, function, parameters = greetings().read({"greeting": "plain", "to": "all"}, "key", "greeting")
    assert (path, function(), parameters) == ("plain", "hello", {"to": "all"})
    check_parameters(polite, {"to": "all"}, path, "key")


@pytest.mark.parametrize("written", ["plain", ["plain"], {"to": "all"}])
def test_what_is_no_mapping_with_the_component_is_refused(written):
    with pytest.raises(InputError) as error:
        greetings().read(written, "key", "greeting")
    assert str(error.value) == f"key: {written} is not {{greeting: package.module:name, parameter: value}}"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"too": "all"}, "key.too: all is no parameter of plain, which has to, loud"),
        ({"loud": True}, "key: plain needs a value for to"),
    ],
)
def test_unknown_and_missing_parameters_are_refused(given, message):
    with pytest.raises(InputError) as error:
        check_parameters(polite, given, "plain", "key")
    assert str(error.value) == message


def test_a_name_is_refused_where_nothing_is_registered():
    with pytest.raises(InputError, match=r"^key: rude is not a path such as package\.module:Name$"):
        Registry("greeting").get("rude", "key")


@pytest.mark.parametrize("name", ["plain", "a:path"])
def test_a_name_is_given_once_and_is_no_path(name):
    with pytest.raises(ValueError, match="the name is taken, or looks like a path"):
        greetings().register(name)(print)


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        (
            "\n\nimport no_such_package\n",
            "importing it raised ModuleNotFoundError: No module named 'no_such_package' (blame_0.py, line 3)",
        ),
        (
            "x = 1\nx.y\n",
            "importing it raised AttributeError: 'int' object has no attribute 'y' (blame_1.py, line 2)",
        ),
        ("def formal(:\n", "importing it raised SyntaxError: invalid syntax (blame_2.py, line 1)"),
        (
            "from damian import sensor\n\n@sensor\ndef formal(state, world): ...\n",
            "formal: write @damian.sensor() above it, with parentheses",
        ),
    ],
)
def test_an_import_that_fails_inside_the_module_blames_its_line(
    tmp_path, monkeypatch, request, code, problem
):
    number = request.node.callspec.indices["code"]
    monkeypatch.chdir(tmp_path)
    (tmp_path / f"blame_{number}.py").write_text(code)
    with pytest.raises(InputError) as error:
        greetings().get(f"blame_{number}:formal", "greeting")
    assert str(error.value) == f"greeting: blame_{number}:formal: {problem}"
