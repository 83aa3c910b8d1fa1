"""Components are found by name or by path, and what cannot be found is said in one line."""

import importlib

import pytest

from damian.common.errors import InputError
from damian.common.registry import Registry, check_parameters, load_plugins
from damian.delays.laws import LAWS, law_of


def greetings():
    registry = Registry("greeting", callable, "is not a function")

    @registry.register("plain")
    def plain():
        return "hello"

    return registry


def polite(*, to, loud=False):
    return f"good day, {to}"


def test_a_registered_component_is_found_by_its_name_and_read_with_its_parameters():
    registry = greetings()
    assert registry.get("plain", "greeting")() == "hello"
    assert list(registry) == ["plain"]
    assert "plain" in registry
    path, function, parameters = registry.read(
        {"greeting": "plain", "to": "all"}, "key", "greeting"
    )
    assert (path, function(), parameters) == ("plain", "hello", {"to": "all"})
    check_parameters(polite, {"to": "all"}, path, "key")


def test_your_own_component_is_found_by_its_path_in_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "polite_words.py").write_text("def formal():\n    return 'good day'\n")
    assert greetings().get("polite_words:formal", "greeting")() == "good day"


def test_a_module_that_was_loaded_again_gives_its_new_component(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    registry = greetings()
    file = tmp_path / "changing_words.py"
    for word in ("good day", "good night"):
        file.write_text(f"def formal():\n    return '{word}'.lower()  # {'longer' * len(word)}\n")
        importlib.reload(importlib.import_module("changing_words"))
        assert registry.get("changing_words:formal", "greeting")() == word
        assert registry["changing_words:formal"]() == word
    file.write_text("formal = 3  # no function any more\n")
    importlib.reload(importlib.import_module("changing_words"))
    with pytest.raises(InputError, match="is not a function"):
        registry.get("changing_words:formal", "greeting")


def test_an_installed_package_registers_names_by_its_entry_point(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lab_components.py").write_text(
        "from damian.delays.laws import LAWS, Constant\n"
        "LAWS.register('lab_relay')(type('Relay', (Constant,), {}))\n"
    )
    info = tmp_path / "my_lab-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-lab\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[damian.plugins]\nmy_lab = lab_components\n")
    load_plugins.cache_clear()
    assert law_of({"law": "lab_relay", "delay": 2}).delay == 2
    del LAWS._components["lab_relay"]


REFUSED = {
    "key: rude is not one of plain, nor a path such as": lambda: greetings().get("rude", "key"),
    "key: nowhere:x: No module named 'nowhere'; nowhere must": lambda: greetings().get(
        "nowhere:x", "key"
    ),
    "key: math:pi is not a function": lambda: greetings().get("math:pi", "key"),
    "key: math:pi is not an int": lambda: Registry("int", int, "is not an int").get(
        "math:pi", "key"
    ),
    "key.too: 1 is not a parameter of plain": lambda: check_parameters(
        polite, {"too": 1}, "plain", "key"
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_used_is_said_in_one_line(message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (its text is compared)
        REFUSED[message]()
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_an_import_that_fails_inside_the_module_blames_its_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "blame.py").write_text("\n\nimport no_such_package\n")
    with pytest.raises(
        InputError, match=r"importing it raised ModuleNotFound.*: .* \(blame\.py, line 3\)"
    ):
        greetings().get("blame:formal", "greeting")
