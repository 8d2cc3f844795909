"""What the documentation says is so: links lead somewhere, code runs, options, settings and keys exist."""

import ast
import importlib.util
import itertools
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from drive_samples import without_pictures, write_drive

from fusion import cli, export, run
from fusion.config import RunConfig

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
WITH_PYTHON = [page for page in PAGES if "```python" in page.read_text()]

FENCE = re.compile(r"^```([\w-]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)

MODULES = {module: name for name, (module, _) in cli.COMMANDS.items()}


def identifier(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a page in one language."""
    return [text for name, text in FENCE.findall(page.read_text()) if name == language]


# --- Links --------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """What headings can be linked by: small letters, hyphens for blanks, nothing else but letters and digits."""
    prose = FENCE.sub("", page.read_text())
    return {re.sub(r"[^\w-]", "", heading.strip().lower().replace(" ", "-")) for heading in HEADING.findall(prose)}


@pytest.mark.parametrize("page", PAGES, ids=identifier)
def test_internal_links_lead_somewhere(page: Path) -> None:
    for link in LINK.findall(FENCE.sub("", page.read_text())):
        if re.match(r"https?://", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{link} leads nowhere"
        if anchor:
            assert anchor in anchors(target), f"{link}: no such heading"


def site() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    return found


def listed(nav: Any) -> Iterator[str]:
    """The pages of a navigation tree."""
    if isinstance(nav, str):
        yield nav
    else:
        for each in nav.values() if isinstance(nav, dict) else nav:
            yield from listed(each)


def test_every_page_is_in_the_navigation_once() -> None:
    pages = list(listed(site()["nav"]))
    assert len(pages) == len(set(pages))
    assert set(pages) == {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}


# --- Code ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as the pages assume it: drive.mcap, its run in runs/drive, and tables of that."""
    folder = tmp_path_factory.mktemp("docs")
    log = write_drive(folder / "drive.mcap")
    exports = run.Presentation(quiet=True, exports=export.Exports(csv=folder / "tables"))
    with without_pictures():
        assert run.run(log, folder / "runs" / "drive", RunConfig(), exports) == 0
    return folder


@pytest.mark.parametrize("page", WITH_PYTHON, ids=identifier)
def test_python_blocks_run(page: Path, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of a page in one namespace, in order."""
    monkeypatch.chdir(workplace)
    if "import pandas" in page.read_text():
        pytest.importorskip("pandas", reason="needs pandas, which is not installed")
    namespace: dict[str, object] = {}
    for block in blocks(page, "python"):
        exec(compile(block, identifier(page), "exec"), namespace)


@pytest.mark.parametrize("page", PAGES, ids=identifier)
def test_toml_blocks_are_valid_configurations(page: Path) -> None:
    import tomllib

    for block in blocks(page, "toml"):
        RunConfig.model_validate(tomllib.loads(block))


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """The commands of ours in the shell blocks of a page, with their arguments."""
    for block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            words = list(itertools.takewhile(lambda word: word not in "|>", shlex.split(line, comments=True)))
            if words[:1] == ["violearner"] and words[1:2] and not words[1].startswith("--"):
                yield words[1], words[2:]
            elif len(words) > 2 and words[0].endswith("python") and words[1] == "-m" and words[2] in MODULES:
                yield MODULES[words[2]], words[3:]


def options_of(name: str, arguments: list[str]) -> set[str]:
    """The options of a command, or of the subcommand that the arguments begin with."""
    parser = cli.parser_of(name)
    for action in parser._actions:
        if isinstance(action.choices, dict) and arguments and not action.option_strings:
            parser = action.choices[arguments[0]]
    return {option for action in parser._actions for option in action.option_strings}


@pytest.mark.parametrize("page", PAGES, ids=identifier)
def test_shell_blocks_name_commands_and_options_that_exist(page: Path) -> None:
    for name, arguments in commands(page):
        if name == "completion":
            assert arguments[0] in cli.SHELLS
            continue
        known = options_of(name, arguments)
        for word in arguments:
            option = word.partition("=")[0]
            assert not option.startswith("--") or option in known, f"{name} has no option {option}"


def test_the_pages_show_the_commands() -> None:
    """The test above has something to look at: every command is shown somewhere."""
    shown = {name for page in PAGES for name, _ in commands(page)}
    assert set(cli.COMMANDS) <= shown


# --- Reference ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def generated() -> ModuleType:
    """The hook that fills in the reference."""
    spec = importlib.util.spec_from_file_location("generated", DOCS / "_generated.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_marker_is_filled_in(generated: ModuleType) -> None:
    used = set()
    for page in DOCS.rglob("*.md"):
        used |= set(generated.MARKER.findall(page.read_text()))
        assert "<!-- generated" not in generated.on_page_markdown(page.read_text())
    assert used == set(generated.SECTIONS)


def test_the_reference_lists_every_option_and_setting(generated: ModuleType) -> None:
    text = generated.commands()
    for name in cli.COMMANDS:
        assert f"\n## {name}\n" in "\n" + text
        for option in options_of(name, []):
            assert option in text
    settings = generated.configuration()
    for name, field in RunConfig.model_fields.items():
        section = generated._section(field.annotation)
        for each in [name] if section is None else section.model_fields:
            assert f"| `{each}` |" in settings


def keys(document: Any, prefix: str = "") -> Iterator[str]:
    """The dotted names of all values; lists are values."""
    if isinstance(document, dict):
        for name, value in document.items():
            yield from keys(value, f"{prefix}.{name}" if prefix else name)
    else:
        yield prefix


def test_every_key_of_metrics_json_is_documented(workplace: Path) -> None:
    documented = set(re.findall(r"`([\w.*]+)`", (DOCS / "reference" / "metrics-json.md").read_text()))
    document = json.loads((workplace / "runs" / "drive" / "metrics.json").read_text())
    for key in keys(document):
        general = re.sub(r"^(trajectories|at_end)\.\w+", r"\1.NAME", key)
        open_ended = general.rpartition(".")[0] + ".*"
        assert general in documented or open_ended in documented, f"{key} is not documented"


COUNTING = re.compile(r"\w*findings\.(put|add)|self\._findings\.(put|add)|self\._(report|note)|Damage|skipped\.update")
"""What is called with the name of a warning as its first argument."""

PASSED_ON = {"reader.py: name", "reader.py: damage.name", "recovery.py: name", "run.py: name"}
"""Names that are counted where they come from somewhere else, where they are found as well."""


def words(node: ast.AST, constants: dict[str, str]) -> Iterator[str]:
    """The strings that an expression can be, `*` for a part that only the run knows."""
    if isinstance(node, ast.JoinedStr):
        yield "".join(str(part.value) if isinstance(part, ast.Constant) else "*" for part in node.values)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.Name) and node.id in constants:
        yield constants[node.id]
    else:
        for child in ast.iter_child_nodes(node):
            yield from words(child, constants)


def counted_warnings() -> tuple[set[str], set[str]]:
    """The names that the code counts warnings under, and the expressions of those that it does not spell out."""
    found: set[str] = set()
    unknown: set[str] = set()
    for path in sorted(each for folder in ("fusion", "learned", "io") for each in (ROOT / folder).rglob("*.py")):
        tree = ast.parse(path.read_text())
        constants = {
            ast.unparse(each.targets[0]): each.value.value
            for each in tree.body
            if isinstance(each, ast.Assign)
            and isinstance(each.value, ast.Constant)
            and isinstance(each.value.value, str)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "skipped":
                found.update(words(node.slice, constants))
            if not isinstance(node, ast.Call) or not node.args:
                continue
            if COUNTING.fullmatch(ast.unparse(node.func)):
                said = set(words(node.args[0], constants))
                found |= said
                if not said:
                    unknown.add(f"{path.name}: {ast.unparse(node.args[0])}")
    return found, unknown


def test_every_warning_that_can_be_counted_is_documented_and_no_other() -> None:
    counted, unknown = counted_warnings()
    assert unknown == PASSED_ON, "a name that this test cannot find"
    _, _, section = (DOCS / "reference" / "metrics-json.md").read_text().partition("## Warnings")
    documented = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    assert sorted(re.sub("ROLE|NAME", "*", name) for name in documented) == sorted(counted)


def test_every_column_of_the_tables_is_documented(workplace: Path) -> None:
    """By its name on the x axis, or the name without an index."""
    text = (DOCS / "reference" / "tables.md").read_text()
    for path in (workplace / "tables").glob("*.csv"):
        for column in path.read_text().partition("\n")[0].split(","):
            first = re.sub(r"(?<=_)[yz](?=_)", "x", re.sub(r"(?<=error_)\d+$", "0", column))
            assert f"`{first}`" in text or f"`{column}`" in text, f"{path.stem}: {column} is not documented"
