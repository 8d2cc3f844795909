"""One name for all commands, and what a command line owes its user: help, suggestions, completion, silence."""

import io
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fusion import cli, run
from fusion_io import progress

HEAVY = {"numpy", "scipy", "torch", "gtsam", "matplotlib", "pydantic", "rich", "plotly", "asyncio"}


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_help_of_every_command_answers_at_once(name: str) -> None:
    """Without importing what is heavy, so that it costs no more than Python itself."""
    script = (
        f"import sys\nfrom fusion.cli import main\ntry:\n    main(['{name}', '--help'])\nexcept SystemExit as end:\n"
        f"    loaded = {HEAVY} & set(sys.modules)\n    sys.exit(str(loaded) if end.code or loaded else 0)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.startswith("usage: ")
    assert "codes:" in result.stdout


def test_the_list_of_commands_needs_none_of_the_heavy_packages(capsys: pytest.CaptureFixture[str]) -> None:
    script = (
        "import sys\nfrom fusion.cli import main\n"
        f"code = main(['--help'])\nloaded = {HEAVY} & set(sys.modules)\nsys.exit(str(loaded) if loaded else code)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    for name, (_, purpose) in cli.COMMANDS.items():
        assert name in result.stdout
        assert purpose in result.stdout


def test_without_a_command_the_commands_are_listed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["violearner"])
    assert cli.main() == 0
    assert capsys.readouterr().out.startswith("usage: violearner COMMAND")


@pytest.mark.parametrize(("typed", "meant"), [("rnu", "run"), ("analyze", "analyse"), ("compar", "compare")])
def test_an_unknown_command_ends_with_2_and_the_nearest_name(
    typed: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([typed]) == 2
    assert f"did you mean {meant!r}" in capsys.readouterr().err


def test_a_command_gives_its_own_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "--log", str(tmp_path / "none.mcap")]) == 1
    assert capsys.readouterr().err.startswith("error: ")


def test_an_interrupted_command_ends_with_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(arguments: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("fusion.export.main", interrupted)
    assert cli.main(["export", "x.mcap"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_and_usage_errors_show_the_command_as_it_was_called(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--help"], ["--no-such-option"]):
        with pytest.raises(SystemExit):
            cli.main([name, *words])
        captured = capsys.readouterr()
        assert (captured.out + captured.err).startswith(f"usage: violearner {name} ")


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_option_says_what_it_does(name: str) -> None:
    for action in cli.parser_of(name)._actions:
        assert action.help or action.option_strings == [] or action.choices, f"{name} {action.option_strings}"


# --- Completion ---------------------------------------------------------------------------------


@pytest.mark.parametrize("shell", cli.SHELLS)
def test_a_shell_is_told_every_command_and_its_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for word in (*cli.COMMANDS, "--backend", "posegraph", "kitti-odometry"):
        assert word in script


def test_bash_completes_a_command_and_an_option(tmp_path: Path) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("needs bash")
    script = tmp_path / "completion"
    script.write_text(cli.completion(["bash"]))

    def completed(*words: str) -> set[str]:
        line = " ".join(f"'{word}'" for word in words)
        lines = (
            f"source '{script}'",
            f"COMP_WORDS=({line})",
            f"COMP_CWORD={len(words) - 1}",
            "_shtab_violearner 2>/dev/null",
            'printf "%s\\n" "${COMPREPLY[@]}"',
        )
        done = subprocess.run([bash, "-c", "\n".join(lines)], capture_output=True, text=True, check=False)
        return set(done.stdout.split())

    assert "run" in completed("violearner", "r")
    assert "--backend" in completed("violearner", "run", "--ba")


@pytest.mark.parametrize("arguments", [[], ["fish"], ["bash", "zsh"]])
def test_completion_for_no_known_shell_is_a_usage_error(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["completion", *arguments]) == 2
    assert "bash, zsh, tcsh" in capsys.readouterr().err


# --- Progress -----------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_shows_count_rate_and_time_left_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERM", "xterm")
    assert list(progress.track(iter(range(3)), "count", 3)) == [0, 1, 2]
    shown = sys.stderr.getvalue()  # type: ignore[attr-defined]
    for words in ("count", "0/3", "left"):
        assert words in shown


def test_silence_asked_for_means_no_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    items = [1, 2]
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(progress, "_silent", False)
    progress.silence()
    assert progress.track(items, "count") is items
    progress.silence(False)
    assert progress.track(items, "count") is not items


def test_without_a_terminal_a_long_loop_says_now_and_then_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line each period, without colours or line feeds that go back; a short loop says nothing."""
    seconds = iter(range(0, 10_000, 10))  # an item takes ten of them
    monkeypatch.setattr(progress, "monotonic", lambda: next(seconds))
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert list(progress.track([1, 2], "short")) == [1, 2]
    assert sys.stderr.getvalue() == ""  # type: ignore[attr-defined]
    assert list(progress.track(range(8), "replay")) == list(range(8))
    assert list(progress.track(iter("abcde"), "count")) == list("abcde")
    assert sys.stderr.getvalue().splitlines() == [  # type: ignore[attr-defined]
        "replay: 2 of 8, 0.067/s, 90 s left",
        "replay: 5 of 8, 0.083/s, 36 s left",
        "count: 2, 0.067/s",
    ]


def test_the_options_of_a_run_are_listed_with_examples(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run.main(["--help"])
    shown = capsys.readouterr().out
    for words in ("examples:", "python -m fusion.run --log drive.mcap", "--quiet", "--json", "default: both", "130"):
        assert words in shown
